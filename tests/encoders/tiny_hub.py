"""Folders of SigLIP, SigLIP 2 and MetaCLIP 2 with few random weights, written by transformers itself, with real
tokenizers of few tokens."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import transformers
from tokenizers import Tokenizer, decoders, models, normalizers, pre_tokenizers, processors

SIDE, PATCH, LENGTH, WIDTH = 32, 8, 16, 32
"""Of images, in pixels; of texts, in tokens; of vectors."""
_WORDS = ("red", "mug", "table", "wine", "bottle", "a", "the", "on")
_TINY = {"hidden_size": WIDTH, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}


def _pieces(special: Sequence[str], bytes_too: bool) -> tuple[dict[str, int], list[tuple[str, str]]]:
    """Vocabulary and merges of byte pairs that know some words."""
    letters = [chr(code) for code in range(33, 127)]
    fallback = [f"<0x{code:02X}>" for code in range(256)] if bytes_too else []
    names, merges = list(dict.fromkeys([*special, *fallback, "▁", *letters])), []
    for word in _WORDS:
        whole = ""
        for part in (*word, "▁")[-1:] + tuple(word):
            if whole and whole + part not in names:
                names.append(whole + part)
                merges.append((whole, part))
            whole += part
    return {name: number for number, name in enumerate(names)}, merges


def _ending(tokenizer: Any, first: str, end: str, number: int, start: int = 0) -> None:
    """Puts the end behind every text, and perhaps something before it."""
    single = f"{first} $A {end}".strip()
    known = [(end, number), *([(first, start)] if first else [])]
    tokenizer.post_processor = processors.TemplateProcessing(single=single, special_tokens=known)


def siglip_tokenizer() -> Any:
    """Like the tokenizer.json of SigLIP: lower case; </s> ends texts and fills them up. (The library's own
    SiglipTokenizer needs sentencepiece and a file of another kind.)"""
    vocabulary, _ = _pieces(["<pad>", "</s>", "<unk>"], bytes_too=False)
    scores = [(name, 0.0 if number < 3 else -20.0 + len(name)) for name, number in vocabulary.items()]
    tokenizer = Tokenizer(models.Unigram(scores, unk_id=2, byte_fallback=False))
    tokenizer.normalizer = normalizers.Sequence([normalizers.Lowercase(), normalizers.Strip()])
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    tokenizer.decoder = decoders.Metaspace()
    _ending(tokenizer, "", "</s>", 1)
    return transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        eos_token="</s>",
        pad_token="</s>",
        unk_token="<unk>",
        padding_side="right",
        model_input_names=["input_ids"],
    )


def siglip2_tokenizer() -> Any:
    """The library's own Siglip2Tokenizer, which lowers texts."""
    vocabulary, merges = _pieces(["<pad>", "<eos>", "<bos>", "<unk>", "<mask>"], bytes_too=True)
    tokenizer = transformers.Siglip2Tokenizer(
        vocab=vocabulary, merges=merges, padding_side="right", model_input_names=["input_ids"]
    )
    _ending(tokenizer.backend_tokenizer, "", "<eos>", 1)
    return tokenizer


def metaclip_tokenizer() -> Any:
    """The library's own tokenizer of XLM-RoBERTa."""
    vocabulary, _ = _pieces(["<s>", "<pad>", "</s>", "<unk>"], bytes_too=False)
    scores = [(name, 0.0 if number < 4 else -20.0 + len(name)) for name, number in vocabulary.items()]
    return transformers.XLMRobertaTokenizer(vocab=[*scores, ("<mask>", 0.0)])


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


def _siglip(folder: Path, tokenizer: Any, images: Any, seed: int) -> None:
    text = {**_TINY, "vocab_size": len(tokenizer), "max_position_embeddings": LENGTH}
    config = transformers.SiglipConfig(
        text_config={**text, "bos_token_id": 0, "eos_token_id": 1},
        vision_config={**_TINY, "image_size": SIDE, "patch_size": PATCH},
    )
    _write(folder, transformers.SiglipModel(config), transformers.SiglipProcessor(images, tokenizer), seed)


def write_siglip(folder: Path, seed: int = 0) -> None:
    """SigLIP: bicubic images, as its processor says."""
    size = {"height": SIDE, "width": SIDE}
    images = transformers.SiglipImageProcessor(size=size, resample=3, image_mean=[0.5] * 3, image_std=[0.5] * 3)
    _siglip(folder, siglip_tokenizer(), images, seed)


def write_siglip2(folder: Path, seed: int = 0) -> None:
    """SigLIP 2 of fixed resolution: the architecture of SigLIP, another tokenizer."""
    size = {"height": SIDE, "width": SIDE}
    images = transformers.SiglipImageProcessor(size=size, resample=2, image_mean=[0.4] * 3, image_std=[0.3] * 3)
    _siglip(folder, siglip2_tokenizer(), images, seed)


def write_naflex(folder: Path, seed: int = 0) -> None:
    """SigLIP 2 for images of any shape."""
    tokenizer = siglip2_tokenizer()
    text = {**_TINY, "vocab_size": len(tokenizer), "max_position_embeddings": LENGTH}
    config = transformers.Siglip2Config(
        text_config={**text, "bos_token_id": 2, "eos_token_id": 1},
        vision_config={**_TINY, "num_patches": 16, "patch_size": PATCH},
    )
    images = transformers.Siglip2ImageProcessor(patch_size=PATCH, max_num_patches=20)
    _write(folder, transformers.Siglip2Model(config), transformers.Siglip2Processor(images, tokenizer), seed)


def write_metaclip2(folder: Path, seed: int = 0) -> None:
    """MetaCLIP 2, whose joint space is narrower than its layers."""
    tokenizer = metaclip_tokenizer()
    config = transformers.MetaClip2Config(
        text_config={
            **_TINY,
            "vocab_size": len(tokenizer),
            "max_position_embeddings": LENGTH,
            "eos_token_id": 2,
            "bos_token_id": 0,
        },
        vision_config={**_TINY, "image_size": SIDE, "patch_size": PATCH},
        projection_dim=24,
    )
    images = transformers.CLIPImageProcessor(size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE})
    _write(folder, transformers.MetaClip2Model(config), transformers.CLIPProcessor(images, tokenizer), seed)


WRITERS = {
    "siglip": ("siglip", write_siglip),
    "siglip2": ("siglip2", write_siglip2),
    "naflex": ("siglip2", write_naflex),
    "metaclip2": ("metaclip2", write_metaclip2),
}
"""Name of the encoder, and what writes a folder for it."""
