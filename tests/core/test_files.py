from pathlib import Path

import pytest

from normlift_ns.core.files import file_name, free_path


@pytest.mark.parametrize("text", ["../../etc/passwd", 'a\\b:c*?"<>|', "x" * 300, "tea\npot\0", "..", "~", "größe 7"])
def test_a_text_never_leaves_its_folder(text: str, tmp_path: Path):
    path = tmp_path / f"{file_name(text)}.ply"
    assert path.resolve().parent == tmp_path.resolve()
    assert len(path.name) <= 44
    path.write_text("")
    assert list(tmp_path.iterdir()) == [path]


def test_a_free_path_leaves_what_exists_alone(tmp_path: Path):
    path = tmp_path / "red.ply"
    assert free_path(path) == path
    path.touch()
    assert free_path(path) == tmp_path / "red_2.ply"
    (tmp_path / "red_2.ply").touch()
    assert free_path(path) == tmp_path / "red_3.ply"
