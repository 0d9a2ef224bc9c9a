"""A person before the page of ns-normlift-view."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from normlift_ns.server.permalink import PageView
from tests.browser.person import Person, coloured

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator

_BARE = ".bare #stage > :not(#canvas, #still), .bare #toasts, .bare #tip { visibility: hidden; }"
CALM = """() => {
  const {scene, revision} = page;
  if (!page.started) return false;
  if (!scene) return !document.querySelector("#still").hidden && !page.stills.waiting;
  const {splats, busy, waiting, coarse, plain, spark} = scene;
  return splats && spark.activeSplats > 0 && !(busy || waiting || coarse || plain || spark.sorting) && revision > 0;
}"""
"""True once the scene is drawn as finely as it gets."""
_WATCH = """() => {
  const {scene, view} = page, {spark, renderer, splats} = scene, centers = [];
  scene.scene.children.find((one) => one.numSplats).forEachSplat((i, center) => centers.push(...center.toArray()));
  const canvas = document.createElement("canvas"), context = canvas.getContext("2d", {willReadFrequently: true});
  const sort = spark.sortWorker.call.bind(spark.sortWorker);
  let order = null;
  spark.sortWorker.call = async (...task) => {
    const result = await sort(...task);
    order = result.ordering.slice(0, result.activeSplats);
    return result;
  };
  spark.sortedDir.setScalar(0);  // sorts once more
  window.frames45 = [];
  const draw = renderer.render.bind(renderer);
  renderer.render = (what, camera) => {
    draw(what, camera);
    if (renderer.getRenderTarget() !== null) return;
    [canvas.width, canvas.height] = [160, 100];
    context.drawImage(renderer.domElement, 0, 0, 160, 100);
    const pixels = context.getImageData(0, 0, 160, 100).data;
    let covered = 0, unsorted = 0;
    for (let i = 0; i < pixels.length; i += 4) covered += Math.abs(pixels[i] - pixels[i + 1]) + pixels[i] > 30 ? 1 : 0;
    if (order) {
      const forward = camera.getWorldDirection(camera.position.clone());
      const depth = (i) => centers[3 * i] * forward.x + centers[3 * i + 1] * forward.y + centers[3 * i + 2] * forward.z;
      const slack = 0.003 * page.run.radius;
      for (let i = 1; i < order.length; i++) unsorted += depth(order[i]) > depth(order[i - 1]) + slack ? 1 : 0;
    }
    frames45.push({covered: covered / 16000, unsorted: order && unsorted / order.length, splats: spark.activeSplats});
  };
}"""
"""Looks at every frame: the share of pixels that show the scene, and of neighbors in the wrong order."""

_HOVER = """async (rays) => {
  const found = [], {connection} = page;
  for (const ray of rays) {
    found.push(await new Promise((resolve) => {
      const hear = ({message}) => {
        if (message.seq !== seq) return;
        connection.removeEventListener("hover", hear);
        resolve(message);
      };
      connection.addEventListener("hover", hear);
      const seq = connection.send("hover", ray);
    }));
  }
  return found;
}"""
"""What the server tells of some rays."""


class OnPage(Person):
    """A browser tab with the page of ns-normlift-view."""

    def __init__(self, browser: Browser, address: str, size: tuple[int, int] = (1000, 640), **how: Any) -> None:
        super().__init__(browser, address, size, **how)
        self.ready()

    def prepare(self) -> None:
        """Keeps what the browser complains about, and addresses of other servers."""
        note = self.problems.append
        self.page.on("console", lambda line: note(line.text) if "Content Security" in line.text else None)
        local = ("http://127.0.0.1", "ws://127.0.0.1", "blob:", "data:")
        self.page.on("request", lambda one: None if one.url.startswith(local) else note(one.url))

    def ready(self) -> None:
        self.until(lambda: self.page.evaluate("window.page?.state?.details ?? false"), "a state")
        self.page.add_style_tag(content=_BARE)
        self.calm()

    def calm(self) -> None:
        self.until(lambda: self.page.evaluate(CALM), "the scene is drawn")

    def state(self, name: str) -> Any:
        return self.page.evaluate(f"page.state.{name}")

    def selected(self) -> int:
        return self.state("selected")

    def press(self, name: str) -> None:
        self.button(name).first.click()

    def does(self, element: str) -> None:
        self.page.locator(f"#{element}").click()

    @property
    def prompts(self) -> Locator:
        return self.page.get_by_role("searchbox", name="Search the scene")

    def ask(self, line: str, *, key: bool = True) -> None:
        """Types prompts and presses Enter or Ask, and waits for the answer."""
        before = self.page.evaluate("page.revision")
        self.prompts.fill(line)
        self.prompts.press("Enter") if key else self.press("Ask")
        self.until(lambda: self.page.evaluate("page.state.revision") > before, f"an answer to {line!r}")

    def chips(self) -> list[str]:
        return self.page.locator("#answers .chip").all_inner_texts()

    def changes(self, act: Callable[[], Any], what: str) -> int:
        before = self.selected()
        act()
        return self.selects(lambda count: count != before, what)

    def click(self, place: tuple[float, float], *, hold: str = "") -> None:
        if hold:
            self.page.keyboard.down(hold)
        self.page.mouse.click(*place)
        if hold:
            self.page.keyboard.up(hold)

    def trace(self, *places: tuple[float, float]) -> None:
        """Drags the pointer along some places."""
        self.page.mouse.move(*places[0])
        self.page.mouse.down()
        for place in places[1:]:
            self.page.mouse.move(*place, steps=3)
        self.page.mouse.up()

    def shot(self) -> np.ndarray:
        """RGB of the scene as it is now, without what lies over it."""
        box = self.page.locator("#stage").bounding_box()
        self.page.evaluate("document.body.classList.add('bare')")
        shot = self.page.screenshot(clip=box, animations="disabled")  # type: ignore[arg-type]
        self.page.evaluate("document.body.classList.remove('bare')")
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"))

    def sees(self, true: Callable[[np.ndarray], Any], what: str) -> np.ndarray:
        """RGB of the scene, once it is drawn and something holds of it."""
        shots: list[np.ndarray] = []

        def holds() -> bool:
            self.calm()
            shots.append(self.shot())
            return bool(true(shots[-1]))

        self.until(holds, what)
        return shots[-1]

    def toast(self) -> tuple[str, dict[str, float]]:
        toast = self.page.locator(".toast").last
        toast.wait_for()
        return toast.inner_text(), toast.bounding_box() or {}  # type: ignore[return-value]

    def watch(self) -> None:
        """Looks at every frame from now on."""
        self.calm()
        self.page.evaluate(_WATCH)
        self.page.evaluate("page.scene.invalidate('order')")
        self.until(lambda: self.page.evaluate("frames45.some((frame) => frame.unsorted !== null)"), "sorted again")
        self.page.evaluate("frames45.length = 0")

    def changes_quickly(self, pause: int) -> None:
        """Makes 22 changes of the colors, faster than the scene is drawn; no frame is missing or unsorted."""
        revision = self.page.evaluate("page.revision")
        modes = [f"mode-{name}" for name in ("heat", "prompts", "rgb", "reliability", "pca", "overlay")]
        names = "hide show invert invert undo redo undo grow shrink isolate show hide show theme"
        for step in [*modes, *(f"do-{name}" for name in names.split()), "mode-rgb", "mode-overlay"]:
            self.does(step)
            self.page.wait_for_timeout(pause)
        self.until(lambda: self.page.evaluate("page.revision") >= revision + 20, "changes")
        self.calm()
        frames = self.page.evaluate("frames45")
        assert len(frames) >= 10
        assert [frame for frame in frames if frame["splats"] != frames[0]["splats"] or frame["covered"] < 0.02] == []
        assert [frame for frame in frames if (frame["unsorted"] or 0) > 0.002] == []

    def pointed(self, count: int = 100) -> tuple[int, int]:
        """Points at random places: how often the pointer tells what the server finds there with its own camera, and how
        often it names a prompt just where the picture has a color. The picture has the colors of the prompts."""
        self.does("mode-prompts")
        drawn = coloured(self.sees(lambda seen: coloured(seen).any(), "colors"))
        view = {**self.page.evaluate("page.view.view()")}
        view["fov"] = float(np.radians(view["fov"]))
        camera = PageView(**view).camera(16384)
        turn, origin = camera.world_to_camera[:3, :3].double(), camera.camera_to_world()[:3, 3]
        rng = np.random.default_rng(0)
        places = rng.integers(8, [drawn.shape[1] - 8, drawn.shape[0] - 8], (count, 2))
        ahead = np.c_[places + 0.5, np.ones(count)] @ np.linalg.inv(camera.K.double().numpy()).T @ turn.numpy()
        theirs = [{"origin": origin.tolist(), "direction": one.tolist()} for one in ahead]
        ours = [self.page.evaluate("([x, y]) => page.view.ray(x, y)", [x + 0.5, y + 0.5]) for x, y in places.tolist()]
        found = list(zip(*(self.page.evaluate(_HOVER, rays) for rays in (ours, theirs)), places))
        names = ("label", "relevancy", "reliability", "object", "position")
        same = [all(one[name] == other[name] for name in names) for one, other, _ in found]
        named = [(one["label"] is not None) == bool(drawn[y, x]) for one, _, (x, y) in found]
        return sum(same), sum(named)

    def measured(self, name: str) -> list[float]:
        """Milliseconds from a press to "colors", to a "coarse" picture or to the full "picture"."""
        return self.page.evaluate(f"performance.getEntriesByName('{name}', 'measure').map((one) => one.duration)")
