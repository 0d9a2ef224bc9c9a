"""What lets viser's page live in a browser without WebGL."""

from __future__ import annotations

import base64
import re

SCRIPT = """
(() => {
  const plain = HTMLCanvasElement.prototype.getContext;
  const probe = plain.call(document.createElement("canvas"), "webgl2");
  if (probe) {
    const extension = probe.getExtension("WEBGL_lose_context");
    if (extension) extension.loseContext();
    return;
  }
  window.normliftBlind = true;
  const numbers = {}, names = {};
  const number = (name) => {
    if (!(name in numbers)) {
      numbers[name] = 1 + Object.keys(numbers).length;
      names[numbers[name]] = name;
    }
    return numbers[name];
  };
  const parameter = (name) =>
    name === "VERSION" ? "WebGL 2.0" :
    name === "SHADING_LANGUAGE_VERSION" ? "WebGL GLSL ES 3.00" :
    ["VIEWPORT", "SCISSOR_BOX"].includes(name) ? new Int32Array(4) :
    name && name.startsWith("MAX_") ? 1024 : 0;
  const answers = {
    getParameter: (which) => parameter(names[which]),
    getExtension: () => null,
    getSupportedExtensions: () => [],
    getContextAttributes: () => ({}),
    getShaderPrecisionFormat: () => ({precision: 23, rangeMin: 127, rangeMax: 127}),
    getProgramParameter: (program, which) => (names[which] || "").startsWith("ACTIVE_") ? 0 : true,
    getShaderParameter: () => true,
    getProgramInfoLog: () => "",
    getShaderInfoLog: () => "",
    getShaderSource: () => "",
    getUniformLocation: () => null,
    getAttribLocation: () => -1,
    getError: () => 0,
    isContextLost: () => false,
    checkFramebufferStatus: () => number("FRAMEBUFFER_COMPLETE"),
    clientWaitSync: () => number("ALREADY_SIGNALED"),
  };
  const context = (canvas) => new Proxy({}, {get: (_, name) =>
    name === "canvas" ? canvas :
    name === "constructor" ? {name: "WebGL2RenderingContext"} :
    name === "drawingBufferWidth" ? canvas.width :
    name === "drawingBufferHeight" ? canvas.height :
    name === "drawingBufferColorSpace" ? "srgb" :
    typeof name !== "string" ? undefined :
    name in answers ? answers[name] :
    name === name.toUpperCase() ? number(name) :
    name.startsWith("create") || name === "fenceSync" ? () => ({}) : () => undefined});
  const kept = new WeakMap();
  HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
    if (kind !== "webgl2") return plain.call(this, kind, ...rest);
    if (!kept.has(this)) kept.set(this, context(this));
    return kept.get(this);
  };
})();
"""
"""For the head of the page. Without WebGL, three.js throws and React takes the whole page away, panel and all; so it
gets a context that draws nothing. Panel, camera and clicks then work as ever, and pictures come from the server.
"""

_PICTURE = """
(() => {
  const canvas = document.querySelector("canvas[data-engine]");
  if (!canvas) return;
  let shown = document.getElementById("normlift_still");
  if (!shown) {
    shown = document.createElement("img");
    shown.id = "normlift_still";
    shown.style.cssText = "position: absolute; inset: 0; width: 100%; height: 100%; pointer-events: none";
    canvas.parentElement.append(shown);
  }
  shown.src = "data:image/jpeg;base64,CONTENT";
})();
"""


def with_script(page: bytes) -> bytes:
    """The page with the script before all others, and without viser's report of every visit to Google.

    >>> with_script(b"<html><head><title>")[:20]
    b'<html><head><script>'
    """
    page = re.sub(rb"<!-- Google tag.*?</script>.*?</script>", b"", page, count=1, flags=re.DOTALL)
    return page.replace(b"<head>", b"<head><script>" + SCRIPT.encode() + b"</script>", 1)


def picture_script(jpeg: bytes) -> str:
    """What the page runs to show a picture in place of the scene."""
    return _PICTURE.replace("CONTENT", base64.b64encode(jpeg).decode())
