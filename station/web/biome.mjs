// Runs Biome, the formatter and linter. Its npm package would name a binary for ten platforms, which not every registry
// has; package.json names those of the platforms that this project is developed on.
import { spawnSync } from "node:child_process";
import { createRequire } from "node:module";

const name = `@biomejs/cli-${process.platform}-${process.arch}/biome${process.platform === "win32" ? ".exe" : ""}`;
const { status } = spawnSync(createRequire(import.meta.url).resolve(name), process.argv.slice(2), {
  stdio: "inherit",
});
process.exit(status ?? 1);
