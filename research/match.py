"""PSNR of renders on photographs, with the right focal length and with wrong ones.

python -m research.match
"""

from __future__ import annotations

from normlift_ns import open_scene
from normlift_ns.data.alignment import mean_psnr
from tests.captures import SHARED

FACTORS = (1.0, 1.01, 1.02, 1.05)


def main() -> None:
    """Prints the table of docs/splats.md."""
    for name in ("fox", "tabletop"):
        scene = open_scene(SHARED / "captures" / "outputs" / name / "splatfacto" / "run" / "config.yml")
        print(f"| {name} | " + " | ".join(f"{mean_psnr(scene, factor):.1f}" for factor in FACTORS) + " |")


if __name__ == "__main__":
    main()
