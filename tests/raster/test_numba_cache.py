"""Compiled code where nothing can be kept on disk, as in containers that nobody may write to."""

import numba
import pytest

from normlift_ns.raster.numba_compiling import compiled


def test_without_a_place_for_a_cache_kernels_are_compiled_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    njit, asked = numba.njit, []

    def nowhere(cache: bool = False, **options: object):
        asked.append(cache)
        if cache:
            raise RuntimeError("cannot cache function 'twice': no locator available for file 'twice.py'")
        return njit(**options)

    with monkeypatch.context() as patch:
        patch.setattr(numba, "njit", nowhere)
        twice = compiled()(lambda x: 2 * x)
    assert twice(21) == 42
    assert asked == [True, False]
