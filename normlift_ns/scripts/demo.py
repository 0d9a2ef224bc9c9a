"""Earlier module path of `normlift_ns.cli.demo`."""

from normlift_ns.cli.common import run_command_process
from normlift_ns.cli.demo import Demo

if __name__ == "__main__":
    run_command_process(Demo)
