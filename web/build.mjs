/** Builds the page into normlift_ns/page, or into the folder given as argument. */
import { cp, mkdir, rm } from "node:fs/promises";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const target = resolve(process.argv[2] ?? join(here, "..", "normlift_ns", "page"));
await rm(target, { recursive: true, force: true });
await mkdir(join(target, "assets"), { recursive: true });
await build({
  entryPoints: { page: join(here, "src", "main.js"), style: join(here, "src", "style.css") },
  outdir: join(target, "assets"),
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "eof",
  loader: { ".svg": "dataurl" },
  logLevel: "warning",
});
await cp(join(here, "index.html"), join(target, "index.html"));
