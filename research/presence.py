"""Verdicts on words that are visible in captures and on words that are absent, from labels/presence.json.

    python -m research.presence fox=RUN/config.yml castle=RUN/config.yml     results/presence.json

Keys: <capture>.<encoder>.<list>.<verdict>, the share of the list's words with that verdict;
<capture>.<encoder>.<list>.words, their number. The lists were written before any query.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import get_args

import normlift_ns as nl
from normlift_ns.query.threshold import Verdict
from research.null_words import LISTS
from research.report import Report


def measure(report: Report, capture: str, config: Path) -> None:
    """Add the counts of one lifted capture."""
    run, table = nl.open_run(config), json.loads(LISTS.read_text())
    encoder = str(run.field.manifest["encoder"]["encoder"]).replace("colour", "color")
    lists = table["captures"][capture][encoder]
    for name, words in {"absent": table.get(f"{encoder}_absent", []), **lists}.items():
        found = {finding.text: finding.verdict for finding in run.ask(*words)}
        print(capture, encoder, name, found)
        counts = Counter(found.values())
        report.add(f"{capture}.{encoder}.{name}.words", len(words), "words")
        for verdict in get_args(Verdict):
            report.add(f"{capture}.{encoder}.{name}.{verdict}", 100 * counts[verdict] / len(words), "%")


def main() -> None:
    """Write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="CAPTURE=config.yml of a lifted run")
    report = Report("presence")
    for text in parser.parse_args().runs:
        capture, config = text.split("=", 1)
        measure(report, capture, Path(config))
    report.write()


if __name__ == "__main__":
    main()
