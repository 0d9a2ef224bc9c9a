"""In place of ns-normlift, for tests of many captures: it makes a run in a moment, and fails as the capture says.

Imports nothing of ours, because it is started for every capture.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

FACTS = {"schema_version": 1, "num_gaussians": 1, "dimension": 1, "means_fingerprint": "", "form": "evidence"}


def main(flags: list[str]) -> None:
    words = dict(zip(flags[::2], flags[1::2]))
    config = Path(words["--load-config"])
    with (config.parents[4] / "begun.txt").open("a") as begun:
        begun.write(f"{config.parents[2].name} {os.getpid()}\n")
    what = config.with_name("what.txt").read_text()
    print("Opening", config)
    if what == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if what == "fail":
        sys.exit("the photographs are [/gone]")
    if what == "bug":
        print("This is a bug", file=sys.stderr)
        sys.exit(70)
    time.sleep(float(what))
    run = config.parents[2] / "normlift" / words["--timestamp"]
    draft = run.with_name(f".draft{os.getpid()}")
    (draft / "normlift").mkdir(parents=True)
    (draft / "normlift" / "manifest.json").write_text(json.dumps(FACTS))
    try:
        draft.rename(run)  # only one can
    except OSError:
        sys.exit(f"{run} exists")


if __name__ == "__main__":
    main(sys.argv[1:])
