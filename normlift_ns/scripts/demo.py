"""Old path of `normlift_ns.cli.demo`."""

from normlift_ns.cli.demo import entrypoint

if __name__ == "__main__":
    entrypoint()
