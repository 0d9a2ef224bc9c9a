"""Minutes of the tests by part, for the budget in CONTRIBUTING.md, from the output of pytest --junitxml.

    make test JUNIT=--junitxml=tests.xml; python -m research.minutes tests.xml

The figures are sums over tests and their fixtures. Two processes share the tests, so the real time is shorter.
"""

import sys
from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree


def minutes(path: str | Path) -> dict[str, float]:
    """Return minutes by folder of tests, or by file for tests outside of folders; the longest first."""
    seconds: defaultdict[str, float] = defaultdict(float)
    for case in ElementTree.parse(path).iter("testcase"):
        seconds["/".join(case.attrib["classname"].split(".")[:2])] += float(case.attrib["time"])
    return {part: seconds[part] / 60 for part in sorted(seconds, key=seconds.__getitem__, reverse=True)}


if __name__ == "__main__":
    for part, found in minutes(sys.argv[1]).items():
        print(f"{found:6.2f}  {part}")
