/** Build the page into normlift_ns/page, with the licenses of the packages that it contains. */
import { cp, mkdir, readFile, rm, writeFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const target = join(here, "..", "normlift_ns", "page");

await rm(target, { recursive: true, force: true });
await mkdir(join(target, "assets"), { recursive: true });
const { metafile } = await build({
  entryPoints: { page: join(here, "src", "main.js"), style: join(here, "src", "style.css") },
  outdir: join(target, "assets"),
  absWorkingDir: here,
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "none",
  metafile: true,
  logLevel: "warning",
});
await cp(join(here, "index.html"), join(target, "index.html"));
// the server sends these to browsers that accept gzip
for (const name of ["page.js", "style.css"]) {
  const path = join(target, "assets", name);
  await writeFile(`${path}.gz`, gzipSync(await readFile(path), { level: 9 }));
}

// Spark bundles fflate
const names = Object.keys(metafile.inputs).map((path) => path.match(/node_modules\/((?:@[^/]+\/)?[^/]+)/)?.[1]);
const packages = [...new Set([...names.filter(Boolean), "fflate"])].sort();
const licenses = packages.map(async (name) => {
  const folder = join(here, "node_modules", name);
  const { version } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
  return `${name} ${version}\n\n${await readFile(join(folder, "LICENSE"), "utf8")}`;
});
await writeFile(join(target, "assets", "licenses.txt"), (await Promise.all(licenses)).join(`\n${"-".repeat(72)}\n\n`));
