// The page's configuration from its server.

import type { Config } from "../base/contract";

export async function load(): Promise<Config> {
  const answer = await fetch("config.json", { cache: "no-store" });
  if (!answer.ok) throw new Error(`config.json: the server answered ${answer.status}`);
  return (await answer.json()) as Config;
}
