// The page's configuration from its server.

import type { Config, VehiclesAnswer } from "../base/contract";
import { enter } from "./admission";
import { ask } from "./answers";

// A page that begins knows the cars' parameters, if the server tells them in this time.
const FRESH_MS = 1_000;

export async function load(): Promise<Config> {
  const answer = await fetch("config.json", { cache: "no-store" });
  if (!answer.ok) throw new Error(`config.json: the server answered ${answer.status}`);
  const config = (await answer.json()) as Config;
  await enter(config);
  if (!config.answers) return config;
  const known = await ask<VehiclesAnswer>("vehicles", {}, AbortSignal.timeout(FRESH_MS)).catch(
    () => undefined,
  );
  return { ...config, vehicles: { ...config.vehicles, ...known?.vehicles } };
}
