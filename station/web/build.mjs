// Bundles the page into station/iort_station/page/built: `npm run build`, or `npm run build -- --watch`.

import { cpSync, mkdirSync, readFileSync, rmSync, statSync, writeFileSync } from "node:fs";
import { dirname, join, relative } from "node:path";
import { fileURLToPath } from "node:url";
import { build, context } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const root = join(here, "..", "..");
const modules = join(root, "node_modules");
const out = join(root, "station", "iort_station", "page", "built");
const watch = process.argv.includes("--watch");

const options = {
  platform: "browser",
  target: ["chrome123", "firefox120", "safari17.5"],
  bundle: true,
  minify: !watch,
  sourcemap: true,
  legalComments: "none",
  outdir: out,
  logLevel: "warning",
};
const builds = [
  {
    ...options,
    format: "esm",
    entryPoints: { page: join(here, "src", "main.ts"), style: join(here, "style.css") },
  },
  { ...options, format: "iife", entryPoints: { worker: join(here, "src", "worker.ts") } },
];

rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });
for (const name of ["index.html", "icon.svg"]) cpSync(join(here, name), join(out, name));

// PubNub's licence: unmodified copies may be passed on, with the licence. So its SDK is a file of its own.
cpSync(join(modules, "pubnub", "dist", "web", "pubnub.min.js"), join(out, "pubnub.min.js"));
// A page loads one of the two, as its deployment sends live messages.
cpSync(join(modules, "mqtt", "dist", "mqtt.min.js"), join(out, "mqtt.min.js"));
const licences = [
  ["iort", "https://www.apache.org/licenses/LICENSE-2.0", join(root, "LICENSE")],
  [
    "PubNub JavaScript SDK (pubnub.min.js, as published)",
    "https://github.com/pubnub/javascript",
    join(modules, "pubnub", "LICENSE"),
  ],
  [
    "MQTT.js (mqtt.min.js, as published)",
    "https://github.com/mqttjs/MQTT.js",
    join(modules, "mqtt", "LICENSE.md"),
  ],
  ["aws4fetch (bundled)", "https://github.com/mhart/aws4fetch", join(modules, "aws4fetch", "LICENSE")],
  ["uPlot (bundled)", "https://github.com/leeoniya/uPlot", join(modules, "uplot", "LICENSE")],
];
const texts = licences.map(
  ([name, url, file]) => `${name}\n${url}\n\n${readFileSync(file, "utf8").trim()}\n`,
);
writeFileSync(join(out, "licences.txt"), texts.join(`\n${"-".repeat(78)}\n\n`));

if (watch) {
  for (const each of builds) await (await context(each)).watch();
} else {
  for (const each of builds) await build(each);
  for (const name of ["page.js", "worker.js", "pubnub.min.js", "mqtt.min.js", "style.css", "index.html"]) {
    const file = join(out, name);
    console.log(
      `${relative(root, file).padEnd(24)} ${(statSync(file).size / 1024).toFixed(1).padStart(7)} KB`,
    );
  }
}
