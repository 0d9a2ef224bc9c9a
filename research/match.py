"""PSNR of renders on photographs, with the right focal length and with wrong ones.

python -m research.match
"""

from __future__ import annotations

from normlift_ns import open_scene
from normlift_ns.data.alignment import focal_psnrs
from tests.captures import SHARED

FACTORS = (1.0, 1.01, 1.02, 1.05)


def main() -> None:
    """Prints the table of docs/splats.md."""
    for name in ("fox", "tabletop"):
        scene = open_scene(SHARED / "captures" / "outputs" / name / "splatfacto" / "run" / "config.yml")
        print(f"| {name} | " + " | ".join(f"{psnr:.1f}" for psnr in focal_psnrs(scene, FACTORS)) + " |")


if __name__ == "__main__":
    main()
