/** Icons as SVG paths for strokes, 24 units wide and high. */

const PATHS = {
  search: "M10.5 4a6.5 6.5 0 1 0 0 13a6.5 6.5 0 1 0 0-13zM15.5 15.5L20 20",
  select: "M6 3.5l12 8-5.5 1.2L9.8 18z M12.6 13l3.6 6.5",
  rectangle: "M4 8V5.5h3M17 5.5h3V8M20 16v2.5h-3M7 18.5H4V16M10 5.5h4M10 18.5h4M4 11v2M20 11v2",
  lasso:
    "M12 4c5 0 8.5 2.2 8.5 5.300s-3.5 5.3-8.5 5.3-8.5-2.2-8.5-5.300S7 4 12 4zM7 14c-1.6.6-2 2.8 0 3.400s2.4 2.6.6 3.1",
  brush: "M14.5 5.500l4 4-7.5 7.5-4-4zM7 13c-2.6.4-2 3.8-4 5 2.5 2 7 1.6 8-1M14.5 5.500l2-2 4 4-2 2",
  measure: "M3 15.500L15.5 3 21 8.5 8.5 21zM7 11.500l2 2M10 8.500l3 3M13 5.500l2 2",
  camera: "M4 8h3.500L9 5.500h6L16.5 8H20v11H4zM12 10.200a3.2 3.2 0 1 0 0 6.400a3.2 3.2 0 1 0 0-6.400z",
  link: "M10 14a4 4 0 0 0 5.7 0l3-3a4 4 0 0 0-5.7-5.700l-1 1M14 10a4 4 0 0 0-5.7 0l-3 3a4 4 0 0 0 5.7 5.700l1-1",
  help: "M12 3.500a8.5 8.5 0 1 0 0 17a8.5 8.5 0 1 0 0-17zM9.5 9.500c0-3.3 5-3.3 5 0 0 2-2.5 2-2.5 4M12 16.500v.5",
  theme: "M12 4a8 8 0 1 0 0 16a8 8 0 1 0 0-16zM12 4v16M12 7.500c5 0 5 9 0 9",
  compare: "M12 3.500v17M4 6.500h5v11H4zM15 6.500h5v11h-5zM17.5 6.500v11",
  home: "M4 11.500L12 4.500l8 7M6.5 10v9h11v-9",
  hide: "M4 12c4-6.5 12-6.5 16 0-1 1.7-2.4 3-3.9 3.800M14 16.700C10 17.6 6.4 15.8 4 12M4 4l16 16",
  show: "M4 12c4-6.5 12-6.5 16 0-4 6.5-12 6.5-16 0zM12 9.600a2.4 2.4 0 1 0 0 4.800a2.4 2.4 0 1 0 0-4.800z",
  isolate: "M12 8.500a3.5 3.5 0 1 0 0 7a3.5 3.5 0 1 0 0-7zM4 8V4h4M16 4h4v4M20 16v4h-4M8 20H4v-4",
  invert: "M5 5h14v14H5zM5 19L19 5M19 9v10H9M13 19l6-6M16.5 19l2.5-2.5",
  undo: "M8 5L4 9l4 4M4 9h10a5 5 0 0 1 0 10H8",
  redo: "M16 5l4 4-4 4M20 9H10a5 5 0 0 0 0 10h6",
  clear: "M6 6l12 12M18 6L6 18",
  grow: "M12 5v14M5 12h14",
  shrink: "M5 12h14",
  why: "M5 5h14v10h-7l-4 4v-4H5zM10 8.500c0-2 4-2 4 0 0 1.2-2 1.2-2 2.300M12 12.600v.2",
  download: "M12 4v11M7.5 10.500L12 15l4.5-4.500M5 19.500h14",
  go: "M12 4a8 8 0 1 0 0 16a8 8 0 1 0 0-16zM12 1.500v5M12 17.500v5M1.5 12h5M17.5 12h5",
  save: "M5 4h11l3 3v13H5zM8 4v5h7V4M8 20v-6h8v6",
  trash: "M5 7h14M9 7V4h6v3M7 7l1 13h8l1-13M10.5 10.500v6M13.5 10.500v6",
  alike: "M8 5a3 3 0 1 0 0 6a3 3 0 1 0 0-6zM16 5a3 3 0 1 0 0 6a3 3 0 1 0 0-6zM12 13a3 3 0 1 0 0 6a3 3 0 1 0 0-6z",
  layers: "M12 4l8.5 4.500L12 13 3.5 8.500zM3.5 12.500L12 17l8.5-4.500M3.5 16L12 20.500l8.5-4.5",
  sparkle: "M12 4l1.8 6.200L20 12l-6.2 1.800L12 20l-1.8-6.200L4 12l6.2-1.800z",
};

/** @param {keyof typeof PATHS} name @returns {SVGSVGElement} */
export function icon(name) {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  svg.setAttribute("class", "icon");
  const path = document.createElementNS(space, "path");
  path.setAttribute("d", PATHS[name]);
  svg.append(path);
  return svg;
}
