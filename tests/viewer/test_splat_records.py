"""What the browser gets: records of 32 bytes, right to float16, also of Gaussians that are flat."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from normlift_ns import GaussianScene
from normlift_ns.rendering.colors import prompt_rgb_tuples
from normlift_ns.session import actions
from normlift_ns.session.prompts import build_query, encode_prompts
from normlift_ns.session.state import State
from normlift_ns.viewer.adapter import _unpack_splats
from normlift_ns.viewer.shared import BYTES, Units, cholesky, legend, make_records, opacities, painted
from tests.session.worlds import BLOCK, read, rows, world
from tests.viewer.scenes import camera, scene_of, spheres


def gaussians(count: int, seed: int = 0, thinnest: float = -3.0) -> GaussianScene:
    g = torch.Generator().manual_seed(seed)
    scales = torch.rand(count, 3, generator=g) * -thinnest + thinnest
    quats = torch.randn(count, 4, generator=g)
    return GaussianScene(torch.randn(count, 3, generator=g), quats, scales.exp(), torch.rand(count, generator=g))


def covariances(found: GaussianScene, least: float = 0.0) -> np.ndarray:
    """In float64, by the rotation of scipy."""
    quats = found.quats.double().numpy()[:, [1, 2, 3, 0]]
    scales = found.scales.double().numpy()
    scales = np.maximum(scales, least * scales.max(axis=1, keepdims=True))
    axes = Rotation.from_quat(quats).as_matrix() * scales[:, None, :]
    return axes @ axes.swapaxes(1, 2)


def assembled(factors: np.ndarray) -> np.ndarray:
    lower = np.zeros((len(factors), 3, 3))
    lower[:, [0, 1, 2, 1, 2, 2], [0, 0, 0, 1, 1, 2]] = factors
    return lower @ lower.swapaxes(1, 2)


def test_factors_are_those_of_the_covariance_also_of_flat_and_point_like_gaussians():
    for thinnest in (-3.0, -9.0):
        found = gaussians(500, thinnest=thinnest)
        factors, expected = cholesky(found, torch.arange(500)), covariances(found, 1e-4)
        size = np.abs(expected).max(axis=(1, 2), keepdims=True)
        assert (np.abs(assembled(factors) - expected) / size).max() < 1e-13
        assert (factors[:, [0, 3, 5]] > 0).all()
    scales = torch.tensor([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1e8, 1e-20, 1e-20]])
    quats = torch.tensor([[1.0, 0, 0, 0], [0.3, -0.5, 0.1, 0.8], [1, 1, 1, 1], [0, 0, 1, 0]])
    flat = GaussianScene(torch.zeros(4, 3), quats, scales, torch.ones(4))
    factors = cholesky(flat, torch.arange(4))
    assert np.isfinite(factors).all()
    np.testing.assert_allclose(assembled(factors)[:2], covariances(flat)[:2], atol=1e-7)


def test_records_hold_the_scene_in_units_of_the_browser():
    found, rgb = gaussians(300), torch.rand(300, 3, generator=torch.Generator().manual_seed(1))
    records = make_records(scene_of(found, rgb, (camera(),)))
    expected = (found.opacities >= 1 / 255).nonzero().squeeze(1).numpy()
    np.testing.assert_array_equal(records.rows, expected)
    buffer = records.buffer(records.colours, np.ones(len(expected), bool))
    assert buffer.nbytes == BYTES * len(expected)
    back = _unpack_splats(buffer)
    np.testing.assert_allclose(records.units.to_scene(back["centers"]), found.means.numpy()[expected], atol=1e-6)
    np.testing.assert_allclose(back["rgbs"] / 255, rgb.numpy()[expected], atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(back["opacities"][:, 0], found.opacities.numpy()[expected], atol=0.5 / 255 + 1e-6)
    exact = covariances(found)[expected] * records.units.factor**2
    assert (np.abs(back["covariances"] - exact) / np.abs(exact).max(axis=(1, 2), keepdims=True)).max() < 2e-3
    some = np.arange(len(expected)) % 3 == 0
    np.testing.assert_array_equal(records.buffer(records.colours, some), buffer[some])


def test_what_cannot_be_drawn_and_the_faintest_and_smallest_of_too_many_are_left_out():
    found = gaussians(200)
    records = make_records(scene_of(found), 50)
    area = found.opacities * found.scales.topk(2, dim=1).values.prod(dim=1)
    assert set(records.rows.tolist()) == set(area.topk(50).indices.tolist())
    assert records.left_out == int((found.opacities >= 1 / 255).sum()) - 50
    assert f"{records.left_out:,}" in records.facts and make_records(scene_of(found)).left_out == 0
    broken = gaussians(200)
    broken.means[3], broken.means[4, 0] = torch.nan, torch.inf
    assert {3, 4} & set(make_records(scene_of(broken)).rows.tolist()) == set()
    assert Units.of([], np.zeros((0, 3))) == Units((0.0, 0.0, 0.0), 1.0)
    assert Units.of([], np.ones((5, 3))).factor == 1.0


def test_colours_show_what_is_selected_and_hidden():
    space = world()
    records = make_records(scene_of(spheres(space.means)))
    prompts, question = build_query(space.field, encode_prompts("red, blue", read), read, negatives=())
    state = actions.set_color_mode(actions.ask(State(space), prompts, question), "prompts")
    colours, drawn = painted(records, state)
    assert drawn.all()
    grey = int(records.colours[0, 0] * 0.8)
    for number, colour in ((0, prompt_rgb_tuples(["red"])[0]), (BLOCK, prompt_rgb_tuples(["blue"])[0])):
        np.testing.assert_allclose(colours[number], 0.15 * grey + 0.85 * 255 * np.array(colour), atol=1)
    assert colours[3 * BLOCK].tolist() == 3 * [grey]
    state = actions.set_color_mode(actions.hide(actions.show_prompt(state, 0)), "overlay")
    colours, drawn = painted(records, state)
    assert drawn.reshape(4, -1).all(axis=1).tolist() == [False, True, False, True]
    assert colours[BLOCK].tolist() == 3 * [grey]
    assert colours[0].tolist() == [253, 231, 37]  # the best match: all of the last colour of the map
    by_hand = actions.add(State(space, color_mode="overlay"), rows(1))
    assert painted(records, by_hand)[0][BLOCK].tolist() == [255, 191, 26]
    assert "0.80 relevancy 1.00" in legend(state)
    colours, _ = painted(records, actions.set_color_mode(state, "reliability"))
    assert len(np.unique(colours, axis=0)) >= 2
    assert "0.00 reliability R 1.00" in legend(actions.set_color_mode(state, "reliability"))
    np.testing.assert_array_equal(painted(records, actions.set_color_mode(state, "rgb"))[0], records.colours)


def test_a_faint_selection_can_be_seen():
    space = world()
    faint = torch.arange(len(space)) < BLOCK
    records = make_records(scene_of(spheres(space.means, 0.1, torch.where(faint, 0.02, 0.9))))
    plain = State(space)
    chosen = actions.set_color_mode(actions.select(plain, faint), "overlay")
    shown = opacities(records, chosen)
    assert set(shown[:BLOCK].tolist()) == {160}
    np.testing.assert_array_equal(shown[BLOCK:], records.alpha[BLOCK:])
    buffer = records.buffer(*painted(records, chosen), shown)
    np.testing.assert_array_equal(buffer[:, 7] >> 24, shown)
    for by_hand in (chosen, actions.set_color_mode(actions.add(plain, faint), "overlay")):
        assert legend(by_hand) == ""
    for state in (
        plain,
        actions.set_color_mode(chosen, "rgb"),
        actions.set_color_mode(actions.select(plain, ~faint), "overlay"),
    ):
        np.testing.assert_array_equal(opacities(records, state), records.alpha)
