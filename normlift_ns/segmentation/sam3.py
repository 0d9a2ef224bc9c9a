"""Masks of SAM 3 for text prompts, with the unchanged model, processor and post-processing of transformers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, UInt8
from torch import Tensor

from normlift_ns.core.device import AdaptiveBatches
from normlift_ns.errors import InputError
from normlift_ns.io.atomic import file_digest
from normlift_ns.options import DEFAULT_SAM3, SamPrecision, short_repr
from normlift_ns.segmentation.checkpoint import (
    TEXT_PROMPT_FAMILIES,
    WEIGHTS_FILE,
    check_sam_checkpoint,
    check_versions,
    checkpoint_errors,
    import_transformers,
    load_pretrained_sam,
    locate_sam,
    read_sam_family,
    resolve_precision,
    transformers_folder,
)
from normlift_ns.segmentation.regions import RegionDefaults, stack_masks

SCORE_THRESHOLD = 0.5
"""Score up to which masks are dropped, as in the model card.

The score of a mask is the score of the instance times the presence score of the prompt.
"""
_MASK_THRESHOLD = 0.5
"""Probability above which a pixel is in a mask."""
TOKENIZER_FILES = ("tokenizer.json", "tokenizer_config.json", "special_tokens_map.json", "vocab.json", "merges.txt")
_MAX_TOKENS = 32
_TOGETHER = 16
"""Maximum number of image-sized masks per batch."""


class TextMasks(NamedTuple):
    """Instances of one text prompt in one image."""

    masks: Bool[Tensor, "m h w"]
    scores: Float[Tensor, " m"]
    """Scores in 0..1."""

    @property
    def union(self) -> Bool[Tensor, "h w"]:
        """Union of all masks."""
        return self.masks.any(dim=0)


class Sam3Network:
    """A SAM 3 network on one device and in one precision. Half precision uses autocast."""

    def __init__(self, model: Any, tokenizer: Any, device: str, precision: SamPrecision = "auto") -> None:
        self._model, self._device = model.to(device), torch.device(device)
        self._dtype: torch.dtype = getattr(torch, resolve_precision(precision, device))
        side = model.config.vision_config.image_size
        image_processor = import_transformers().Sam3ImageProcessor(size={"height": side, "width": side})
        self._processor = import_transformers().Sam3Processor(image_processor, tokenizer)
        self._batches = AdaptiveBatches(_TOGETHER)
        self._text_features: dict[str, tuple[Any, Tensor]] = {}

    @classmethod
    def load(cls, checkpoint: str, device: str, precision: SamPrecision = "auto") -> Sam3Network:
        """Load the network of a checkpoint, which is a folder or a name on the Hugging Face hub.

        Raises:
            FileNotFoundError: If the checkpoint is not on this machine and cannot be downloaded.
            ValueError: If the checkpoint is damaged or belongs to another network, or the installed torch or
                transformers is too old.
        """
        path = locate_sam(checkpoint, TEXT_PROMPT_FAMILIES, TOKENIZER_FILES)
        with checkpoint_errors(path, "SAM 3"):
            folder = transformers_folder(path)
            if folder is None:
                raise InputError("it is a file, expected a folder with config.json, model.safetensors and a tokenizer")
            kind = read_sam_family(folder, TEXT_PROMPT_FAMILIES)
        check_versions(kind)
        with checkpoint_errors(path, "SAM 3"):
            model = load_pretrained_sam(folder, kind)
            if not any((folder / name).is_file() for name in ("tokenizer.json", "vocab.json")):
                raise InputError("the folder has neither tokenizer.json nor vocab.json with merges.txt")
            tokenizer = import_transformers().CLIPTokenizer.from_pretrained(folder, local_files_only=True)
        return cls(model, tokenizer, device, precision)

    @torch.no_grad()
    def segment(self, image: UInt8[Tensor, "h w 3"], texts: Sequence[str]) -> list[TextMasks]:
        """Return the instances of each text prompt, on the device.

        Raises:
            ValueError: If a prompt has more than 32 tokens.
        """
        channels_first = image.to(self._device).permute(2, 0, 1)
        pixels = self._processor(images=channels_first, return_tensors="pt")["pixel_values"]
        with self._autocast():
            vision = self._model.get_vision_features(pixels.to(self._device))
        return [self._instances(vision, text, (image.shape[0], image.shape[1])) for text in texts]

    def _instances(self, vision: Any, text: str, size: tuple[int, int]) -> TextMasks:
        with self._autocast():
            features, mask = self._encode_text(text)
            output = self._model(vision_embeds=vision, text_embeds=features, attention_mask=mask)
        logits, presence = output.pred_logits[0].float(), output.presence_logits[0].float()
        rows = (logits.sigmoid() * presence.sigmoid() > SCORE_THRESHOLD).nonzero()[:, 0]

        def post_process(index: Tensor) -> tuple[Tensor, Tensor]:
            part = SimpleNamespace(
                pred_logits=logits[None, index],
                presence_logits=presence[None],
                pred_boxes=output.pred_boxes[:, index].float(),
                pred_masks=output.pred_masks[:, index].float(),
            )
            (result,) = self._processor.image_processor.post_process_instance_segmentation(
                part, threshold=SCORE_THRESHOLD, mask_threshold=_MASK_THRESHOLD, target_sizes=[size]
            )
            return result["masks"].bool(), result["scores"]

        parts = [(logits.new_zeros(0, *size).bool(), logits.new_zeros(0)), *self._batches(post_process, rows)]
        return TextMasks(*map(torch.cat, zip(*parts)))

    def _encode_text(self, text: str) -> tuple[Any, Tensor]:
        if text not in self._text_features:
            tokens = self._processor(text=text, return_tensors="pt").to(self._device)
            count = tokens["input_ids"].shape[1]
            if count > _MAX_TOKENS:
                raise InputError(
                    f"SAM 3 accepts at most {_MAX_TOKENS} tokens per prompt, but {short_repr(text)} has {count}; "
                    "use a shorter prompt"
                )
            self._text_features[text] = self._model.get_text_features(**tokens), tokens["attention_mask"]
        return self._text_features[text]

    def _autocast(self) -> Any:
        return torch.autocast(self._device.type, self._dtype, enabled=self._dtype != torch.float32)


def sam3_identity(checkpoint: str, device: str, precision: SamPrecision = "auto") -> dict[str, Any]:
    """Return all settings, except the prompt, that change the masks of SAM 3. Files are identified by their content."""
    path = Path(checkpoint)
    files = (path / name for name in ("config.json", WEIGHTS_FILE, *TOKENIZER_FILES))
    content = file_digest(*(file for file in files if file.is_file())) if path.is_dir() else checkpoint
    resolved = resolve_precision(precision, device)
    return {"kind": "sam3", "checkpoint": content, "precision": resolved, "score": SCORE_THRESHOLD}


@dataclass(frozen=True)
class Sam3Masks(RegionDefaults):
    """Regions that SAM 3 predicts for text prompts, one per instance. Weights are loaded on first use.

    If instances overlap, the lift uses the one with the higher score. Pixels without an instance are unlabeled.

    Raises:
        ValueError: If torch or transformers is missing or too old, or the checkpoint is invalid or belongs to another
            network.
        FileNotFoundError: If the checkpoint is a path that does not exist.
    """

    texts: tuple[str, ...]
    checkpoint: str = DEFAULT_SAM3
    """Folder with weights, or name on the Hugging Face hub."""
    device: str = "cpu"
    precision: SamPrecision = "auto"
    """Precision of the network. "auto" selects float16 on a GPU and float32 on a CPU."""

    def __post_init__(self) -> None:
        check_sam_checkpoint(self.checkpoint, TEXT_PROMPT_FAMILIES)

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Settings from `sam3_identity`, and the prompts."""
        return {**sam3_identity(self.checkpoint, self.device, self.precision), "texts": list(self.texts)}

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "1 depth h w"]:
        """Return label maps as in `Regions.labels`. Raises the errors of `load` and `segment` of `Sam3Network`."""
        masks, scores = (torch.cat(parts) for parts in zip(*self.network.segment(image, self.texts)))
        rows = masks.flatten(1).any(dim=1).nonzero()[:, 0]
        ascending = rows[torch.sort(scores[rows], stable=True).indices]
        return stack_masks(masks[ascending])[None]

    @cached_property
    def network(self) -> Sam3Network:
        """The network with its weights, loaded on first use."""
        return Sam3Network.load(self.checkpoint, self.device, self.precision)
