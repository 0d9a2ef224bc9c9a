"""SAM 2, HQ-SAM and SAM 3 of transformers with few random weights, as transformers writes them."""

import json
import string
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

SIDE = 64
"""Of the input of SAM 2 and HQ-SAM."""
SAM3_SIDE = 56
_PROMPT = {"hidden_size": 32, "image_size": SIDE, "patch_size": 16, "mask_input_channels": 4}
_DECODER = {"hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16}


def _hiera() -> dict[str, Any]:
    sides = {"image_size": [SIDE, SIDE], "window_positional_embedding_background_size": [2, 2]}
    stages = {"blocks": [1, 1, 2, 1], "embed_dim": [8, 16, 32, 64], "num_attention_heads": [1, 1, 2, 2]}
    backbone = {f"{name}_per_stage": values for name, values in {**stages, "window_size": [4] * 4}.items()}
    backbone |= {"model_type": "sam2_hiera_det_model", "hidden_size": 8, "global_attention_blocks": [3], **sides}
    neck = {"backbone_channel_list": [64, 32, 16, 8], "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]]}
    return {"backbone_config": backbone, **neck, "fpn_hidden_size": 32}


def tiny(kind: str, seed: int = 0) -> Any:
    """A model of transformers, by the model type of its config, its weights large enough to matter."""
    transformers = import_module("transformers")
    vit = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": SIDE, "window_size": 2}
    vit |= {"global_attn_indexes": [1], "output_channels": 32, "num_pos_feats": 16, "mlp_dim": 64}
    parts = {"vision_config": _hiera(), "prompt_encoder_config": _PROMPT, "mask_decoder_config": _DECODER}
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        if kind == "sam2":
            model = transformers.Sam2Model(transformers.Sam2Config(**parts))
        elif kind == "sam2_video":
            memory: dict[str, Any] = {f"memory_{name}_hidden_size": 32 for name in ("attention", "encoder")}
            model = transformers.Sam2VideoModel(transformers.Sam2VideoConfig(**parts, image_size=SIDE, **memory))
        elif kind == "sam_hq":
            parts |= {"vision_config": vit, "mask_decoder_config": {**_DECODER, "vit_dim": 32}}
            model = transformers.SamHQModel(transformers.SamHQConfig(**parts))
        else:
            model = transformers.Sam3Model(_sam3())
        with torch.no_grad():
            for name, value in model.named_parameters():
                if value.ndim > 1:
                    value.normal_(std=min(0.5, 1.5 * value[0].numel() ** -0.5))
                elif "norm" not in name and "bias" in name:
                    value.normal_(std=0.1)
            for mlp in getattr(model.mask_decoder, "output_hypernetworks_mlps", []):
                mlp.proj_out.weight *= 8
    return model.eval()


def _sam3() -> Any:
    small = {"hidden_size": 32, "num_attention_heads": 2, "intermediate_size": 32}
    vit = {"model_type": "sam3_vit_model", "num_hidden_layers": 2, "image_size": SAM3_SIDE, "patch_size": 14}
    vit |= {"window_size": 2, "global_attn_indexes": [1], "pretrain_image_size": 28, **small}
    words = {"model_type": "clip_text_model", "vocab_size": 64, "projection_dim": 16, "num_hidden_layers": 1, **small}
    words |= {"max_position_embeddings": 32, "hidden_act": "gelu"}
    return import_module("transformers").Sam3Config(
        vision_config={"backbone_config": vit, "fpn_hidden_size": 32,
                       "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]]},
        text_config={**words, "bos_token_id": 62, "eos_token_id": 63, "pad_token_id": 63},
        geometry_encoder_config={**small, "num_layers": 1},
        detr_encoder_config={**small, "num_layers": 1},
        detr_decoder_config={**small, "num_layers": 1, "num_queries": 12},
        mask_decoder_config={"hidden_size": 32, "num_attention_heads": 2},
    )  # fmt: skip


def write_tiny(folder: Path, kind: str, seed: int = 0) -> Any:
    """Writes the model as transformers does, with the tokenizer of SAM 3; returns it."""
    model = tiny(kind, seed)
    model.save_pretrained(folder)
    if kind == "sam3":
        write_tokenizer(folder)
    return model


def write_tokenizer(folder: Path) -> None:
    pieces = [f"{letter}{end}" for end in ("", "</w>") for letter in string.ascii_lowercase]
    vocabulary = {piece: i for i, piece in enumerate(pieces)} | {"<|startoftext|>": 62, "<|endoftext|>": 63}
    (folder / "vocab.json").write_text(json.dumps(vocabulary))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    import_module("transformers").CLIPTokenizer.from_pretrained(folder).save_pretrained(folder)
