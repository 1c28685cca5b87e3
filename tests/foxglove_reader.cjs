// Reads a recording with the libraries that Foxglove reads it with, and prints it, one JSON value a line:
// a channel {topic, type, md5sum}, or a message {topic, t_ns, message}. Numbers beyond a double are texts. The
// md5sum of a type of ROS 2 is its hash.
// node foxglove_reader.cjs <node_modules> <file.mcap or file.bag> [without]
// With the word "without", messages are decoded and printed as null.
const { createRequire } = require("node:module");
const { open, readFile } = require("node:fs/promises");
const { join, resolve } = require("node:path");

const [modules, path, without] = process.argv.slice(2);
const from = createRequire(join(resolve(modules), "x.js"));
const { parse } = from("@foxglove/rosmsg");
const { MessageReader } = from("@foxglove/rosmsg-serialization");
const { MessageReader: MessageReader2 } = from("@foxglove/rosmsg2-serialization");

function plain(_, value) {
  if (typeof value === "bigint") return value.toString();
  return ArrayBuffer.isView(value) ? Array.from(value) : value;
}

const print = (value) => process.stdout.write(`${JSON.stringify(value, plain)}\n`);
const shown = (message) => (without ? null : message);

// What Foxglove does with a channel: parse the definition, compile a reader of it.
function reader(definition, ros2 = false) {
  return ros2 ? new MessageReader2(parse(definition, { ros2 })) : new MessageReader(parse(definition));
}

async function mcap() {
  const zstd = from("@foxglove/wasm-zstd");
  const lz4 = from("@foxglove/wasm-lz4");
  await Promise.all([zstd.isLoaded, lz4.isLoaded]);
  const decompressHandlers = {
    lz4: (data, size) => lz4(data, Number(size)),
    zstd: (data, size) => zstd.decompress(data, Number(size)),
  };
  const { McapIndexedReader, McapStreamReader } = from("@mcap/core");
  const file = await open(path);
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, size) => {
      const data = new Uint8Array(Number(size));
      const { bytesRead } = await file.read(data, 0, data.length, Number(offset));
      if (bytesRead !== data.length) throw new Error(`read ${bytesRead} of ${size} bytes at ${offset}`);
      return data;
    },
  };
  const indexed = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const readers = new Map();
  for (const [id, channel] of indexed.channelsById) {
    const schema = indexed.schemasById.get(channel.schemaId);
    const ros2 = channel.messageEncoding === "cdr";
    if (schema.encoding !== (ros2 ? "ros2msg" : "ros1msg") || !(ros2 || channel.messageEncoding === "ros1")) {
      throw new Error(`${channel.topic}: ${channel.messageEncoding} of ${schema.encoding}`);
    }
    readers.set(id, reader(new TextDecoder().decode(schema.data), ros2));
    const md5sum = channel.metadata.get(ros2 ? "topic_type_hash" : "md5sum");
    print({ topic: channel.topic, type: schema.name, md5sum });
  }
  for await (const { channelId, logTime, data } of indexed.readMessages()) {
    const { topic } = indexed.channelsById.get(channelId);
    print({ topic, t_ns: logTime.toString(), message: shown(readers.get(channelId).readMessage(data)) });
  }
  await file.close();
  // And without the index, which proves every checksum of the file.
  const stream = new McapStreamReader({ validateCrcs: true, decompressHandlers });
  stream.append(await readFile(path));
  while (stream.nextRecord());
  if (!stream.done()) throw new Error("the file has no end");
}

async function bag() {
  const { Bag } = from("@foxglove/rosbag");
  const { FileReader } = from("@foxglove/rosbag/node");
  const opened = new Bag(new FileReader(path), { parse: false });
  await opened.open();
  const readers = new Map();
  for (const [id, { topic, type, md5sum, messageDefinition }] of opened.connections) {
    readers.set(id, reader(messageDefinition));
    print({ topic, type, md5sum });
  }
  for await (const { topic, connectionId, timestamp, data } of opened.messageIterator()) {
    const t_ns = BigInt(timestamp.sec) * 1_000_000_000n + BigInt(timestamp.nsec);
    print({ topic, t_ns, message: shown(readers.get(connectionId).readMessage(data)) });
  }
}

(path.endsWith(".bag") ? bag() : mcap()).catch((error) => {
  console.error(error);
  process.exitCode = 1;
});
