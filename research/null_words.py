"""Write the null vocabulary: names of objects that queries of scenes rarely contain.

    python -m research.null_words     normlift_ns/encoders/null_words.json

The names are those of 200 classes of ImageNet, drawn with a seed. The classes share no word with the lists of
labels/presence.json, on which the verdicts were measured.
"""

from __future__ import annotations

import json
import random
from pathlib import Path

from normlift_ns.encoders.imagenet import class_names, find_classes
from normlift_ns.errors import InputError

COUNT = 200
LISTS = Path(__file__).parent / "labels" / "presence.json"
TARGET = Path(__file__).parents[1] / "normlift_ns" / "encoders" / "null_words.json"


def listed_words() -> list[str]:
    """Return every text of the lists, both visible and absent."""
    table = json.loads(LISTS.read_text())
    captures = [words for lists in table["captures"].values() for words in lists.values()]
    return [*table["imagenet_absent"], *(text for words in captures for texts in words.values() for text in texts)]


def main() -> None:
    """Write the file."""
    listed = listed_words()
    taken = {word for text in listed for word in text.lower().split()}
    related = set(find_classes("promontory"))  # which "head" meant, of the fox head, when the words were drawn
    for text in listed:
        try:
            related.update(find_classes(text))
        except InputError:  # a color, or another word that is no class
            continue
    free = [
        name
        for number, name in enumerate(class_names())
        if number not in related and not taken & set(name.lower().split())
    ]
    names = sorted(random.Random(0).sample(list(dict.fromkeys(free)), COUNT))
    TARGET.write_text(json.dumps(names, indent=0) + "\n", encoding="utf8")
    print(f"{len(names)} of {len(free)} names")


if __name__ == "__main__":
    main()
