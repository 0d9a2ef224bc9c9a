"""Folders of SigLIP, SigLIP 2 and MetaCLIP 2, written by transformers; tests import this while they run."""

from pathlib import Path
from typing import Any

import torch
import transformers
from tokenizers import Tokenizer, decoders, models, normalizers, pre_tokenizers, processors

SIDE, PATCH, LENGTH, WIDTH = 32, 8, 16, 32
"""Of images, in pixels; of texts, in tokens; of vectors."""
_LETTERS = ("▁", *map(chr, range(33, 127)))
_TINY = {"hidden_size": WIDTH, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}


def _scores(*special: str) -> list[tuple[str, float]]:
    return [(name, 0.0 if name in special else -19.0) for name in (*special, *_LETTERS)]


def _ending(tokenizer: Any, end: str) -> None:
    """Puts the end, token 1, behind every text."""
    tokenizer.post_processor = processors.TemplateProcessing(single=f"$A {end}", special_tokens=[(end, 1)])


def siglip_tokenizer() -> Any:
    """Like the tokenizer.json of SigLIP, whose own class needs sentencepiece: </s> ends texts and fills them up."""
    tokenizer = Tokenizer(models.Unigram(_scores("<pad>", "</s>", "<unk>"), unk_id=2, byte_fallback=False))
    tokenizer.normalizer = normalizers.Sequence([normalizers.Lowercase(), normalizers.Strip()])
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    tokenizer.decoder = decoders.Metaspace()
    _ending(tokenizer, "</s>")
    tokens = {"eos_token": "</s>", "pad_token": "</s>", "unk_token": "<unk>"}
    names = {"padding_side": "right", "model_input_names": ["input_ids"]}
    return transformers.PreTrainedTokenizerFast(tokenizer_object=tokenizer, **tokens, **names)


def siglip2_tokenizer() -> Any:
    """The library's own Siglip2Tokenizer, which lowers texts."""
    names = ("<pad>", "<eos>", "<bos>", "<unk>", "<mask>", *(f"<0x{code:02X}>" for code in range(256)), *_LETTERS)
    vocabulary = {name: number for number, name in enumerate(names)}
    how = {"padding_side": "right", "model_input_names": ["input_ids"]}
    tokenizer = transformers.Siglip2Tokenizer(vocab=vocabulary, merges=[], **how)
    _ending(tokenizer.backend_tokenizer, "<eos>")
    return tokenizer


def metaclip_tokenizer() -> Any:
    return transformers.XLMRobertaTokenizer(vocab=[*_scores("<s>", "<pad>", "</s>", "<unk>"), ("<mask>", 0.0)])


def _write(folder: Path, model: Any, processor: Any, seed: int) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        with torch.no_grad():
            for name, value in model.named_parameters():
                if name == "logit_scale":
                    value.fill_(4.7)
                elif name == "logit_bias":
                    value.fill_(-12.9)
                elif value.ndim > 1 or "class_embedding" in name:
                    value.normal_(std=0.5 * value.shape[-1] ** -0.5 if "embedding" not in name else 0.5)
                elif name.endswith("bias"):
                    value.normal_(std=0.1)
    model.save_pretrained(folder)
    processor.save_pretrained(folder)


def write_hub(folder: Path, name: str, seed: int = 0) -> None:
    """One of the networks of `HUB`: `naflex` is SigLIP 2 for images of any shape."""
    side = {"height": SIDE, "width": SIDE}
    vision = {**_TINY, "image_size": SIDE, "patch_size": PATCH}
    kinds = {"siglip": siglip_tokenizer, "metaclip2": metaclip_tokenizer}
    tokenizer = kinds.get(name, siglip2_tokenizer)()
    text = {**_TINY, "vocab_size": len(tokenizer), "max_position_embeddings": LENGTH}
    if name == "metaclip2":
        text |= {"eos_token_id": 2, "bos_token_id": 0}
        config = transformers.MetaClip2Config(text_config=text, vision_config=vision, projection_dim=24)
        images = transformers.CLIPImageProcessor(size={"shortest_edge": SIDE}, crop_size=side)
        _write(folder, transformers.MetaClip2Model(config), transformers.CLIPProcessor(images, tokenizer), seed)
    elif name == "naflex":
        text |= {"bos_token_id": 2, "eos_token_id": 1}
        vision = {**_TINY, "num_patches": 16, "patch_size": PATCH}
        config = transformers.Siglip2Config(text_config=text, vision_config=vision)
        images = transformers.Siglip2ImageProcessor(patch_size=PATCH, max_num_patches=20)
        _write(folder, transformers.Siglip2Model(config), transformers.Siglip2Processor(images, tokenizer), seed)
    else:  # of fixed resolution, SigLIP 2 has the architecture of SigLIP
        mean, std, resample = (0.5, 0.5, 3) if name == "siglip" else (0.4, 0.3, 2)
        norm = {"image_mean": [mean] * 3, "image_std": [std] * 3}
        images = transformers.SiglipImageProcessor(size=side, resample=resample, **norm)
        config = transformers.SiglipConfig(
            text_config={**text, "bos_token_id": 0, "eos_token_id": 1}, vision_config=vision
        )
        _write(folder, transformers.SiglipModel(config), transformers.SiglipProcessor(images, tokenizer), seed)
