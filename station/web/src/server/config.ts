// What the page is told by the server that serves it: where to listen, and what the fields mean.

export interface Config {
  readonly namespace: string;
  readonly subscribe_key: string;
  readonly origin: string;
  readonly tls: boolean;
  /** PubNub's access token, where its Access Manager is on; empty otherwise. */
  readonly token: string;
  /** Whether the server also answers questions about the past; a static site does not. */
  readonly answers: boolean;
  readonly vehicles: Vehicles;
}

/** The parameters of cars, by their names, as they were registered when this was asked for. */
export type Vehicles = Readonly<Record<string, { readonly speed_to_erpm_gain?: number; readonly speed_to_erpm_offset?: number }>>;

export interface FieldTable {
  /** The contract's schema version: messages of another are refused. */
  readonly version: number;
  /** The stream that carries the VESC's fields. */
  readonly stream: string;
  /** With `ros2_unit` where the ROS 2 driver has another unit. */
  readonly fields: Readonly<Record<string, { readonly unit: string; readonly ros2_unit?: string; readonly meaning: string }>>;
  /** The unit of the fields x, y and z within what ROS' standard messages call so. */
  readonly ros_units: Readonly<Record<string, string>>;
  readonly faults: Readonly<Record<string, string>>;
}

export async function load(): Promise<{ config: Config; table: FieldTable }> {
  const [config, table] = await Promise.all([fetchJson<Config>("config.json"), fetchJson<FieldTable>("fields.json")]);
  return { config, table };
}

async function fetchJson<T>(name: string): Promise<T> {
  const answer = await fetch(name, { cache: "no-store" });
  if (!answer.ok) throw new Error(`${name}: the server answered ${answer.status}`);
  return (await answer.json()) as T;
}
