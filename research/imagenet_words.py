"""Words for the 1,000 classes of ImageNet, from WordNet 3.0: python -m research.imagenet_words /usr/share/wordnet

The command writes normlift_ns/encoders/imagenet_words.json. The folder is that of Debian's package wordnet-base:
index.noun, data.noun, noun.exc and cntlist.rev of Princeton's WordNet 3.0. Its offsets in data.noun are ImageNet's
synset ids. The ids of the classes, in the order of the network's outputs, are read from the existing table, so no other
source is needed.

The names of a class are the lemmas of its synset. A lemma after the first is omitted if the annotated texts of WordNet
use it ten times or more, but never for this synset, such as "head" for a promontory. A hypernym is a synset above one
or more classes, and at most half of them, because "artifact" and "object" do not separate classes. A lemma of several
hypernyms belongs to the one whose sense WordNet lists first. Therefore "cat" means the domestic cat, and not the lion
or the whip. It also belongs to later senses that occur in WordNet's annotated texts and have the same parent, such as
both kinds of furniture that "table" means.
"""

from __future__ import annotations

import json
import sys
from itertools import groupby
from pathlib import Path

import normlift_ns

TABLE = Path(normlift_ns.__file__).parent / "encoders" / "imagenet_words.json"
MANY_USES = 10
"""Number of uses from which a sense without any use is omitted."""
SOURCE = "Made from WordNet 3.0 by research/imagenet_words.py; the license of WordNet:"


def read_synsets(folder: Path) -> tuple[dict[str, list[str]], dict[str, list[str]], str]:
    """Return the lemmas and the hypernyms of every noun synset by its offset, and the license at the top."""
    lemmas, above, license_lines = {}, {}, []
    for line in (folder / "data.noun").read_text("utf8").splitlines():
        if line.startswith("  "):
            license_lines.append(line.split(maxsplit=1)[1] if len(line.split()) > 1 else "\n")
            continue
        offset, _, _, count, *words = line.partition(" | ")[0].split()
        size = 2 * int(count, 16)
        lemmas[offset] = [word.replace("_", " ") for word in words[:size:2]]
        pointers = words[size + 1 :]
        above[offset] = [there for kind, there in zip(pointers[::4], pointers[1::4]) if kind in ("@", "@i")]
    return lemmas, above, " ".join(line.strip() or "\n" for line in license_lines)


def read_senses(folder: Path) -> dict[str, tuple[list[str], int]]:
    """Return the offsets of the synsets of every noun in lower case, the most frequent sense first.

    Each noun also has the number of senses that occur in WordNet's annotated texts.
    """
    senses = {}
    for line in (folder / "index.noun").read_text("utf8").splitlines():
        if not line.startswith(" "):
            word, _, count, *rest = line.split()
            senses[word.replace("_", " ")] = rest[-int(count) :], int(rest[-int(count) - 1])
    return senses


def read_uses(folder: Path) -> dict[str, int]:
    """Return how often WordNet's annotated texts use every noun, in any sense."""
    uses: dict[str, int] = {}
    for line in (folder / "cntlist.rev").read_text("utf8").splitlines():
        key, _, count = line.split()
        word, _, sense = key.partition("%")
        if sense.startswith("1:"):  # a noun
            uses[word.replace("_", " ")] = uses.get(word.replace("_", " "), 0) + int(count)
    return uses


def ranges(numbers: list[int]) -> str:
    """Return ascending numbers as text.

    >>> ranges([1, 4, 5, 6, 9])
    '1 4-6 9'
    """
    runs = [[number for _, number in run] for _, run in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
    return " ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def table(folder: Path, ids: list[str]) -> dict[str, object]:
    """Return the whole table for the synset ids of the classes."""
    lemmas, above, terms = read_synsets(folder)
    senses, uses = read_senses(folder), read_uses(folder)
    below: dict[str, set[int]] = {}
    for number, name in enumerate(ids):
        waiting = list(above[name[1:]])
        while len(waiting) > 0:
            offset = waiting.pop()
            below.setdefault(offset, set()).add(number)
            waiting += above[offset]
    below = {offset: found for offset, found in below.items() if len(found) <= len(ids) // 2}

    def owners(word: str) -> list[str]:
        offsets, attested = senses[word.lower()]
        first = next(offset for offset in offsets if offset in below)
        return [first, *(x for x in offsets[:attested] if x in below and x != first and above[x] == above[first])]

    def means(word: str, offset: str) -> bool:
        offsets, attested = senses[word.lower()]
        return offset in offsets[:attested] or uses.get(word.lower(), 0) < MANY_USES

    kept: dict[str, set[int]] = {}
    for offset in sorted(below):
        words = ", ".join(word for word in lemmas[offset] if offset in owners(word))
        kept[words] = kept.get(words, set()) | below[offset]
    classes = {}
    for name in ids:
        first, *others = lemmas[name[1:]]
        classes[name] = ", ".join([first, *(word for word in others if means(word, name[1:]))])
    hypernyms = {words: ranges(sorted(found)) for words, found in kept.items() if words != ""}
    known = {word.lower() for words in [*classes.values(), *hypernyms] for word in words.split(", ")}
    known |= {word.split()[-1] for word in known}
    pairs = (line.split()[:2] for line in (folder / "noun.exc").read_text("utf8").splitlines())
    plurals = {plural: word for plural, word in pairs if word in known and plural not in known}
    return {"source": SOURCE, "license": terms, "classes": classes, "hypernyms": hypernyms, "plurals": plurals}


if __name__ == "__main__":
    found = table(Path(sys.argv[1]), list(json.loads(TABLE.read_text("utf8"))["classes"]))
    TABLE.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", "utf8")
    sys.stdout.write(f"Written: {TABLE}, {TABLE.stat().st_size:,} bytes\n")
