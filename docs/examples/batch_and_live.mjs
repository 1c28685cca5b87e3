// Store a batch and show a live sample: node batch_and_live.mjs HOST PORT ROBOT FOLDER AUTHORITIES
import { randomBytes } from "node:crypto";
import { readFileSync } from "node:fs";
import { deflateSync } from "node:zlib";
import { connectAsync } from "mqtt";

const [host, port, robot, folder, authorities] = process.argv.slice(2);
const [ca, cert, key] = [authorities, `${folder}/certificate.pem`, `${folder}/private.key`].map((f) => readFileSync(f));
const client = await connectAsync(`mqtts://${host}:${port}`, { clientId: robot, protocolVersion: 5, ca, cert, key });

const [run, now] = [randomBytes(8).toString("hex"), Date.now() * 1000];
const columns = { dt: [0, 20000], fields: { angle: [null, 0.5, 1.5] } };
const samples = deflateSync(JSON.stringify(columns)).toString("base64");
const batch = { v: 2, batch: `${String(now).padStart(16, "0")}-${run}-0`, n: 2, codec: "steps", samples };
await client.publishAsync(`$aws/rules/iort_record/dt/iort/${robot}/arm`, JSON.stringify(batch), { qos: 1 });
const live = { v: 1, boot: run, seq: 0, t: now, sent_us: now, nonfinite: 0, sample: { angle: 1.5 } };
await client.publishAsync(`live/iort/${robot}/arm`, JSON.stringify(live));
await client.endAsync();
