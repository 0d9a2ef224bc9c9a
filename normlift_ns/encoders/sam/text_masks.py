"""SAM 3: texts become masks. transformers' model, processor and post-processing as they are."""

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

from normlift_ns.core.disk.digests import file_digest
from normlift_ns.encoders.batches import Batches
from normlift_ns.encoders.sam.folders import TEXT_KINDS, WEIGHTS, import_transformers, kind_of, load_folder
from normlift_ns.encoders.sam.network import resolve_precision
from normlift_ns.encoders.sam.rules import stack_masks
from normlift_ns.encoders.sam.weights import check_sam, download, folder_of, local_sam, told_of
from normlift_ns.errors import InputError
from normlift_ns.options import DEFAULT_SAM3, SamPrecision
from normlift_ns.ranges import check_texts, shown

SCORE = 0.5
"""A mask counts if its score, of the instance times that of the text being there at all, is above this: the threshold
of the model card."""
_INSIDE = 0.5
"""Probability above which a pixel is in a mask."""
_WORDS = ("tokenizer.json", "tokenizer_config.json", "special_tokens_map.json", "vocab.json", "merges.txt")
_MOST_TOKENS = 32
_TOGETHER = 16
"""Masks at the size of the image at a time."""


class TextMasks(NamedTuple):
    """The instances of one text in one image."""

    masks: Bool[Tensor, "m h w"]
    scores: Float[Tensor, " m"]
    """In 0..1."""

    @property
    def union(self) -> Bool[Tensor, "h w"]:
        """What is in any of them."""
        return self.masks.any(dim=0)


class Sam3Network:
    """SAM 3 on a device, in one precision: under autocast where that is half."""

    def __init__(self, model: Any, tokenizer: Any, device: str, precision: SamPrecision = "auto") -> None:
        self._model, self._device = model.to(device), torch.device(device)
        self._dtype: torch.dtype = getattr(torch, resolve_precision(precision, device))
        side = model.config.vision_config.image_size
        inside = import_transformers().Sam3ImageProcessor(size={"height": side, "width": side})
        self._processor = import_transformers().Sam3Processor(inside, tokenizer)
        self._together = Batches(_TOGETHER)
        self._read: dict[str, tuple[Any, Tensor]] = {}

    @classmethod
    def load(cls, checkpoint: str, device: str, precision: SamPrecision = "auto") -> Sam3Network:
        """The network of a checkpoint, a folder or a name on the hub.

        Raises:
            FileNotFoundError: it is not on this machine and cannot be downloaded.
            ValueError: it is damaged, of another network, or the installed torch or transformers cannot run it.
        """
        path = local_sam(checkpoint) or download(checkpoint, TEXT_KINDS, _WORDS)
        with told_of(path, "SAM 3"):
            folder = folder_of(path)
            if folder is None:
                raise InputError("it is a file; expected a folder with config.json, model.safetensors and a tokenizer")
            model = load_folder(folder, kind_of(folder, TEXT_KINDS))
            if not any((folder / name).is_file() for name in ("tokenizer.json", "vocab.json")):
                raise InputError("the folder has no tokenizer.json, nor vocab.json and merges.txt")
            tokenizer = import_transformers().CLIPTokenizer.from_pretrained(folder, local_files_only=True)
        return cls(model, tokenizer, device, precision)

    @torch.no_grad()
    def find(self, image: UInt8[Tensor, "h w 3"], texts: Sequence[str]) -> list[TextMasks]:
        """The instances of every text, on the device.

        Raises:
            ValueError: a text of more than 32 tokens.
        """
        channels_first = image.to(self._device).permute(2, 0, 1)
        pixels = self._processor(images=channels_first, return_tensors="pt")["pixel_values"]
        with self._half():
            seen = self._model.get_vision_features(pixels.to(self._device))
        return [self._found(seen, text, (image.shape[0], image.shape[1])) for text in texts]

    def _found(self, seen: Any, text: str, size: tuple[int, int]) -> TextMasks:
        with self._half():
            words, mask = self._words(text)
            out = self._model(vision_embeds=seen, text_embeds=words, attention_mask=mask)
        logits, presence = out.pred_logits[0].float(), out.presence_logits[0].float()
        some = (logits.sigmoid() * presence.sigmoid() > SCORE).nonzero()[:, 0]

        def instances(index: Tensor) -> tuple[Tensor, Tensor]:
            part = SimpleNamespace(
                pred_logits=logits[None, index],
                presence_logits=presence[None],
                pred_boxes=out.pred_boxes[:, index].float(),
                pred_masks=out.pred_masks[:, index].float(),
            )
            (one,) = self._processor.image_processor.post_process_instance_segmentation(
                part, threshold=SCORE, mask_threshold=_INSIDE, target_sizes=[size]
            )
            return one["masks"].bool(), one["scores"]

        parts = [(logits.new_zeros(0, *size).bool(), logits.new_zeros(0)), *self._together(instances, some)]
        return TextMasks(*map(torch.cat, zip(*parts)))

    def _words(self, text: str) -> tuple[Any, Tensor]:
        if text not in self._read:
            read = self._processor(text=text, return_tensors="pt").to(self._device)
            count = read["input_ids"].shape[1]
            if count > _MOST_TOKENS:
                raise InputError(f"SAM 3 reads {_MOST_TOKENS} tokens of a text at most, {shown(text)} has {count}")
            self._read[text] = self._model.get_text_features(**read), read["attention_mask"]
        return self._read[text]

    def _half(self) -> Any:
        return torch.autocast(self._device.type, self._dtype, enabled=self._dtype != torch.float32)


def sam3_identity(checkpoint: str, device: str, precision: SamPrecision = "auto") -> dict[str, Any]:
    """All that changes what SAM 3 finds, but the text; files count by their content, wherever they lie."""
    path = Path(checkpoint)
    files = (path / name for name in ("config.json", WEIGHTS, *_WORDS))
    content = file_digest(*(file for file in files if file.is_file())) if path.is_dir() else checkpoint
    used = resolve_precision(precision, device)
    return {"kind": "sam3", "checkpoint": content, "precision": used, "score": SCORE}


@dataclass(frozen=True)
class Sam3Masks:
    """Regions that SAM 3 finds for some texts: every instance is one. Where they overlap that of the higher score
    counts; pixels without one are unlabelled. The weights are loaded at the first use.

    Raises:
        ValueError: no text, or one that is empty or given twice; transformers is not installed; another network.
        FileNotFoundError: a checkpoint that does not exist.
    """

    texts: tuple[str, ...]
    checkpoint: str = DEFAULT_SAM3
    """A folder, or a name on the hub."""
    device: str = "cpu"
    precision: SamPrecision = "auto"
    """Of the network. auto: float16 on a GPU, float32 elsewhere."""

    def __post_init__(self) -> None:
        if len(self.texts) == 0:
            raise InputError(
                'regions "sam3" are what texts find: name them with --queries, such as --queries mug plate'
            )
        check_texts("queries", self.texts)
        check_sam(self.checkpoint, TEXT_KINDS)

    @property
    def identity(self) -> dict[str, Any]:
        """As `sam3_identity`, and the texts."""
        return {**self._kind, "texts": list(self.texts)}

    @property
    def at_once(self) -> int:
        return 1

    @property
    def chosen(self) -> tuple[int, ...]:
        return ()

    def files(self, name: str) -> tuple[Path, ...]:
        return ()

    def labels(self, image: UInt8[Tensor, "h w 3"], name: str) -> Int32[Tensor, "1 depth h w"]:
        """As in `Regions`; raises as `Sam3Network.load` and `Sam3Network.find`."""
        found = self.network.find(image, self.texts)
        masks, scores = (torch.cat(parts) for parts in zip(*found))
        there = masks.flatten(1).any(dim=1).nonzero()[:, 0]
        upwards = there[torch.sort(scores[there], stable=True).indices]
        return stack_masks(masks[upwards])[None]

    @cached_property
    def _kind(self) -> dict[str, Any]:
        return sam3_identity(self.checkpoint, self.device, self.precision)

    @cached_property
    def network(self) -> Sam3Network:
        """The network with its weights, loaded at the first use."""
        return Sam3Network.load(self.checkpoint, self.device, self.precision)
