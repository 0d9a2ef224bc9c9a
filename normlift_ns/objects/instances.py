"""Every Gaussian with one class and one object at most, as the files for other tools have it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from normlift_ns.core.field import SemanticField
from normlift_ns.core.query import strongest
from normlift_ns.objects.parts import connected_components, describe_object
from normlift_ns.options import MIN_SIZE, REACH


@dataclass(frozen=True, eq=False)
class Instances:
    """Classes are texts, objects are the connected parts of a class."""

    texts: tuple[str, ...]
    class_id: Int32[Tensor, " n"]
    """1 for the first text, and so on; 0: none."""
    instance_id: Int32[Tensor, " n"]
    """1, 2, … through all texts, for each of them its largest object first; 0: none, or of a part that is too small."""
    classes: tuple[int, ...]
    """Class of object 1, 2, …"""

    def to_json(self) -> dict[str, Any]:
        """What the numbers mean."""
        sizes = torch.bincount(self.instance_id.long(), minlength=len(self.classes) + 1).tolist()
        return {
            "none": 0,
            "class_id": {str(number): text for number, text in enumerate(self.texts, 1)},
            "instance_id": {
                str(number): {"class_id": of, "text": self.texts[of - 1], "gaussians": sizes[number]}
                for number, of in enumerate(self.classes, 1)
            },
        }


def find_instances(
    texts: tuple[str, ...],
    means: Float[Tensor, "n 3"],
    relevancy: Float[Tensor, "n q"],
    selected: Bool[Tensor, "n q"],
    *,
    reach: float = REACH,
    min_size: int = MIN_SIZE,
) -> Instances:
    """A Gaussian that several texts select belongs to the one of largest relevancy.

    Args:
        reach, min_size: as in `find_objects`.
    Raises:
        ValueError: as `connected_components`.

    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [9, 0, 0], [5, 0, 0]])
    >>> relevancy = torch.tensor([[0.9, 0.8], [0.7, 0.1], [0.6, 0.9], [0.1, 0.2]])
    >>> found = find_instances(("cup", "box"), means, relevancy, relevancy > 0.5, min_size=1)
    >>> found.class_id.tolist(), found.instance_id.tolist(), found.classes
    ([1, 1, 2, 0], [1, 1, 2, 0], (1, 2))
    """
    class_id = strongest(relevancy, selected) + 1
    instance_id = torch.zeros_like(class_id)
    classes: list[int] = []
    for number in range(1, len(texts) + 1):
        labels = connected_components(means, class_id == number, reach=reach)
        sizes = torch.bincount(labels[labels >= 0].long())
        count = int((sizes >= min_size).sum())  # the largest come first
        listed = (labels >= 0) & (labels < count)
        instance_id = torch.where(listed, labels + 1 + len(classes), instance_id)
        classes += [number] * count
    return Instances(texts, class_id, instance_id, tuple(classes))


def tabulate(field: SemanticField, means: Float[Tensor, "n 3"], instances: Instances) -> list[dict[str, Any]]:
    """What is known of the objects of every text, ready for JSON."""
    tables = []
    for number, text in enumerate(instances.texts, 1):
        of_class = instances.class_id == number
        listed = [i for i, of in enumerate(instances.classes, 1) if of == number]
        tables.append({
            "text": text,
            "class_id": number,
            "gaussians": int(of_class.sum()),
            "in_smaller_parts": int((of_class & (instances.instance_id == 0)).sum()),
            "objects": [
                {"instance_id": i, **asdict(describe_object(field, means, instances.instance_id == i))} for i in listed
            ],
        })  # fmt: skip
    return tables
