"""Assignment of each Gaussian to at most one class and one object, for exports to other tools."""

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
    """Class and object of every Gaussian: classes are prompts, objects are connected components of a class."""

    texts: tuple[str, ...]
    class_id: Int32[Tensor, " n"]
    """Class, 1 for the first prompt; 0 if no prompt selects the Gaussian."""
    instance_id: Int32[Tensor, " n"]
    """Object, numbered 1, 2, … over all prompts, by descending size within each prompt. 0 for Gaussians without a class
    or in a component that is too small.
    """
    classes: tuple[int, ...]
    """Class of object 1, 2, …"""

    def to_json(self) -> dict[str, Any]:
        """Return the names of all classes and objects by id, as plain Python types."""
        sizes = torch.bincount(self.instance_id.long(), minlength=len(self.classes) + 1).tolist()
        return {
            "none": 0,
            "class_id": {str(number): text for number, text in enumerate(self.texts, 1)},
            "instance_id": {
                str(number): {"class_id": class_id, "text": self.texts[class_id - 1], "gaussians": sizes[number]}
                for number, class_id in enumerate(self.classes, 1)
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
    """Assign each selected Gaussian to a class and an object.

    A Gaussian that several prompts select belongs to the prompt with the highest relevancy.

    Args:
        reach, min_size: as in `find_objects`.
    Raises:
        ValueError: as in `connected_components`.

    >>> means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [9, 0, 0], [5, 0, 0]])
    >>> relevancy = torch.tensor([[0.9, 0.8], [0.7, 0.1], [0.6, 0.9], [0.1, 0.2]])
    >>> instances = find_instances(("cup", "box"), means, relevancy, relevancy > 0.5, min_size=1)
    >>> instances.class_id.tolist(), instances.instance_id.tolist(), instances.classes
    ([1, 1, 2, 0], [1, 1, 2, 0], (1, 2))
    """
    class_id = strongest(relevancy, selected) + 1
    instance_id = torch.zeros_like(class_id)
    classes: list[int] = []
    for number in range(1, len(texts) + 1):
        labels = connected_components(means, class_id == number, reach=reach)
        sizes = torch.bincount(labels[labels >= 0].long())
        count = int((sizes >= min_size).sum())  # sizes are in descending order
        listed = (labels >= 0) & (labels < count)
        instance_id = torch.where(listed, labels + 1 + len(classes), instance_id)
        classes += [number] * count
    return Instances(texts, class_id, instance_id, tuple(classes))


def tabulate(field: SemanticField, means: Float[Tensor, "n 3"], instances: Instances) -> list[dict[str, Any]]:
    """Return a summary of each prompt and its objects, as plain Python types."""
    tables = []
    for number, text in enumerate(instances.texts, 1):
        in_class = instances.class_id == number
        ids = [i for i, class_id in enumerate(instances.classes, 1) if class_id == number]
        tables.append({
            "text": text,
            "class_id": number,
            "gaussians": int(in_class.sum()),
            "in_smaller_parts": int((in_class & (instances.instance_id == 0)).sum()),
            "objects": [
                {"instance_id": i, **asdict(describe_object(field, means, instances.instance_id == i))} for i in ids
            ],
        })  # fmt: skip
    return tables
