// Bundles the live page into build/web: `npm run build`, or `npm run build -- --watch`.
import { build, context } from "esbuild";
import { cpSync, mkdirSync, rmSync, statSync } from "node:fs";
import { dirname, join, relative } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const root = join(here, "..", "..");
const out = join(root, "build", "web");
const watch = process.argv.includes("--watch");

const options = {
  // PubNub's "browser" entry, which esbuild takes for this platform, holds no code for Node.
  entryPoints: { page: join(here, "src", "main.ts"), style: join(here, "style.css") },
  platform: "browser",
  target: ["chrome123", "firefox120", "safari17.5"],
  format: "esm",
  bundle: true,
  minify: !watch,
  sourcemap: true,
  legalComments: "linked",
  outdir: out,
  logLevel: "warning",
};

rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });
for (const name of ["index.html", "icon.svg"]) cpSync(join(here, name), join(out, name));

if (watch) {
  await (await context(options)).watch();
} else {
  await build(options);
  for (const name of ["page.js", "style.css", "index.html"]) {
    const file = join(out, name);
    console.log(`${relative(root, file).padEnd(24)} ${(statSync(file).size / 1024).toFixed(1).padStart(7)} KB`);
  }
}
