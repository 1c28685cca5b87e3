// The page's configuration from its server.

import type { Config } from "../base/contract";
import { enter } from "./admission";

export async function load(): Promise<Config> {
  const answer = await fetch("config.json", { cache: "no-store" });
  if (!answer.ok) throw new Error(`config.json: the server answered ${answer.status}`);
  const config = (await answer.json()) as Config;
  await enter(config);
  return config;
}
