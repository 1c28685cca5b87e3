// What a viewer sees of a car's camera, without a browser: messages, clocks, and which way the pictures come.

import assert from "node:assert/strict";
import { writeFileSync } from "node:fs";
import { after, describe, test } from "node:test";
import vectors from "../../../tests/unit/contract/video.json";
import { ECHO_KEPT_MS, PICTURE_MAX_AGE_MS, VIEW_RENEW_S } from "../src/base/contract";
import { Marks, RobotClock } from "../src/video/clock";
import { Figures } from "../src/video/figures";
import {
  askClock,
  decodeClock,
  decodeMarks,
  decodePicture,
  decodeShow,
  type IceServer,
  topicsOf,
} from "../src/video/messages";
import type { PeerEnds } from "../src/video/peer";
import { CONNECT_MS, Sight } from "../src/video/sight";

const bytes = (hex: string): Uint8Array<ArrayBuffer> => Uint8Array.from(Buffer.from(hex, "hex"));
const hex = (message: ArrayBuffer): string => Buffer.from(message).toString("hex");
const json = (message: object): Uint8Array => new TextEncoder().encode(JSON.stringify(message));

// What the robot's own reader is asked to read: tests/web/test_logic.py.
const looks: object[] = [];
after(() => process.env.IORT_WIRE && writeFileSync(`${process.env.IORT_WIRE}.looks`, JSON.stringify(looks)));

describe("the messages, by the vectors that the contract has, too", () => {
  test("marks, the clock and pictures are read", () => {
    for (const { marks, hex } of vectors.marks) {
      const read = decodeMarks(bytes(hex).buffer);
      assert.deepEqual(
        read,
        marks.map(([number, us, rtp]) => ({ number, captured_ms: us! / 1e3, rtp })),
      );
    }
    for (const { number, question, now_us, answer } of vectors.clock) {
      assert.equal(hex(askClock(number)), question);
      assert.deepEqual(decodeClock(bytes(answer).buffer), { number, robot_ms: now_us / 1e3 });
    }
    for (const { number, captured_us, sent_us, jpeg, hex } of vectors.picture)
      assert.deepEqual(decodePicture(bytes(hex)), {
        number,
        captured_ms: captured_us / 1e3,
        sent_ms: sent_us / 1e3,
        jpeg: bytes(jpeg),
      });
  });

  test("anything else is none of them", () => {
    for (const each of vectors.garbage) {
      const message = bytes(each);
      const read = [decodeMarks(message.buffer), decodeClock(message.buffer), decodePicture(message)];
      assert.deepEqual(read, [undefined, undefined, undefined], each);
    }
    const show = { v: 1, request: "0123456789abcdef", kind: "refused", why: "no" };
    assert.equal(decodeShow(json(show))?.why, "no");
    for (const change of [
      { v: 2 },
      { request: 1 },
      { kind: "shown" },
      { why: {} },
      { sdp: "v=0" },
      { kind: "answer" },
      { kind: "answer", sdp: "x".repeat(40_000) },
      { kind: "terms" },
      { kind: "terms", terms: { width: 640, height: "480", rate_hz: 15 } },
      { ice_servers: [{ urls: ["https://elsewhere.example"] }] },
      { ice_servers: [{ urls: "stun:elsewhere.example" }] },
    ])
      assert.equal(decodeShow(json({ ...show, ...change })), undefined, JSON.stringify(change));
    for (const text of ["", "{", "[]", "null", "7"])
      assert.equal(decodeShow(new TextEncoder().encode(text)), undefined);
  });
});

describe("the car's clock", () => {
  test("is that of the least round trip, until it is old", () => {
    const clock = new RobotClock();
    assert.equal(clock.offset_ms, undefined);
    clock.heard(1000, 80, 0, 40);
    clock.heard(1030, 200, 1_000, 100);
    assert.equal(clock.offset_ms, 1000);
    clock.heard(1010, 20, 2_000, 10);
    assert.equal(clock.offset_ms, 1010);
    clock.heard(1015, 60, 2_000 + ECHO_KEPT_MS, 30);
    assert.equal(clock.offset_ms, 1015);
  });

  test("that was set is believed at once", () => {
    const clock = new RobotClock();
    clock.heard(1000, 20, 0, 10);
    clock.heard(-5000, 90, 1_000, 45);
    assert.equal(clock.offset_ms, -5000);
  });
});

test("a picture that comes before its mark is known once the mark comes", () => {
  const marks = new Marks();
  const mark = (number: number) => ({ number, captured_ms: number * 100, rtp: number * 9000 });
  assert.equal(marks.seen(9000), false);
  assert.equal(marks.heard([mark(1), mark(2)]), true);
  assert.equal(marks.shown?.number, 1);
  assert.equal(marks.heard([mark(1), mark(2)]), false);
  assert.equal(marks.seen(18_000), true);
  // An older one is no news.
  assert.equal(marks.seen(9000), false);
  assert.equal(marks.shown?.number, 2);
});

test("the figures are about what came since the last time, of the same way", () => {
  const figures = new Figures();
  const counts = { bytes: 0, pictures: 0, packets: 0, lost: 0, rtt_ms: 12 };
  assert.equal(figures.line("webrtc", counts, 0, 640, 480), "");
  const later = { bytes: 100_000, pictures: 15, packets: 95, lost: 5, rtt_ms: 12 };
  assert.equal(
    figures.line("webrtc", later, 1_000, 640, 480),
    "640 × 480, 15.0 pictures/s, 800 kbit/s, 5.0 % lost, round trip 12 ms",
  );
  assert.equal(figures.line("broker", later, 2_000, 640, 480), "");
});

class FakePeer {
  answers: string[] = [];
  closed = false;
  questions: number[] = [];
  constructor(readonly ends: PeerEnds) {}
  offer = async (): Promise<string> => "v=0\r\n";
  answer = async (sdp: string): Promise<void> => void this.answers.push(sdp);
  send = (message: ArrayBuffer): void => void this.questions.push(new DataView(message).getUint32(1));
  close = (): void => void (this.closed = true);
  counts = async () => ({ bytes: 1, pictures: 1, packets: 1, lost: 0, rtt_ms: undefined });
}

const NAMESPACE = "iort";
const TOPICS = topicsOf(NAMESPACE, "car1");
const TERMS = { width: 640, height: 480, rate_hz: 15 };
// The car's clock is ahead of this page's.
const AHEAD_MS = 60_000;

/** A viewer, and the car that is told what to answer. */
class Rig {
  now_ms = 1_000_000;
  readonly peers: FakePeer[] = [];
  readonly heard = new Set<string>();
  readonly sent: Record<string, string>[] = [];
  /** The servers of each session. */
  readonly given: (readonly IceServer[])[] = [];
  servers: () => Promise<readonly IceServer[]> = async () => [];
  /** Why no session can be made. */
  refuses: Error | undefined;
  /** How often one was to be made. */
  asked = 0;
  private names = 0;
  readonly sight: Sight;

  constructor(webrtc = true) {
    this.sight = new Sight(TOPICS, {
      send: (topic, message) => {
        assert.equal(topic, TOPICS.look);
        this.sent.push(message as Record<string, string>);
        looks.push(message);
      },
      hear: (topic, heard) => void (heard ? this.heard.add(topic) : this.heard.delete(topic)),
      servers: () => this.servers(),
      peer: webrtc
        ? (servers, ends) => {
            this.asked += 1;
            if (this.refuses) throw this.refuses;
            this.given.push(servers);
            const peer = new FakePeer(ends);
            this.peers.push(peer);
            return peer;
          }
        : undefined,
      draw: async (jpeg) => jpeg[0] === 0xff,
      newName: () => (this.names += 1).toString(16).padStart(16, "0"),
      now_ms: () => this.now_ms,
    });
    this.sight.connected("");
    this.tick();
  }

  get peer(): FakePeer {
    return this.peers.at(-1)!;
  }

  newest(kind: string): Record<string, string> {
    return this.sent.findLast((look) => look.kind === kind)!;
  }

  count(kind: string): number {
    return this.sent.filter((look) => look.kind === kind).length;
  }

  tick(ms = 0): void {
    this.now_ms += ms;
    this.sight.tick();
  }

  async pass(ms: number): Promise<void> {
    for (let passed = 0; passed < ms; passed += 100) {
      this.tick(100);
      await this.settled();
    }
  }

  settled(): Promise<void> {
    return new Promise((done) => setImmediate(done));
  }

  say(to: string, message: object): void {
    const { viewer, request } = this.newest(to);
    this.sight.hear(TOPICS.answer(viewer!), json({ v: 1, request, ...message }));
  }

  /** The car tells its terms. */
  async terms(): Promise<void> {
    this.now_ms += 40;
    this.say("ask", { kind: "terms", terms: TERMS });
    this.tick();
    await this.settled();
  }

  mark(number: number, age_ms = 30): void {
    const message = new DataView(new ArrayBuffer(17));
    message.setUint8(0, 1);
    message.setUint32(1, number);
    message.setBigInt64(5, BigInt(this.now_ms + AHEAD_MS - age_ms) * 1000n);
    message.setUint32(13, number * 6000);
    this.peer.ends.message(message.buffer);
    this.peer.ends.shown(number * 6000);
  }

  /** The clock's question is answered after 20 ms; or at once, and the answer takes `back_ms`. */
  echo(back_ms?: number): void {
    const message = new DataView(new ArrayBuffer(13));
    message.setUint8(0, 3);
    message.setUint32(1, this.peer.questions.at(-1)!);
    message.setBigInt64(5, BigInt(this.now_ms + AHEAD_MS + (back_ms === undefined ? 10 : 0)) * 1000n);
    this.now_ms += back_ms ?? 20;
    this.peer.ends.message(message.buffer);
  }

  async picture(number: number, age_ms: number, way_ms: number): Promise<void> {
    const message = new DataView(new ArrayBuffer(31));
    message.setUint8(0, 4);
    message.setUint32(1, number);
    message.setBigInt64(5, BigInt(this.now_ms + AHEAD_MS - age_ms) * 1000n);
    message.setBigInt64(13, BigInt(this.now_ms + AHEAD_MS - way_ms) * 1000n);
    message.setUint16(29, 0xffd8);
    this.sight.hear(TOPICS.picture, new Uint8Array(message.buffer));
    await this.settled();
  }
}

/** A viewer with a WebRTC session that shows a picture. */
async function seeing(): Promise<Rig> {
  const rig = new Rig();
  await rig.terms();
  rig.say("offer", { kind: "answer", sdp: "v=0" });
  rig.peer.ends.open();
  rig.echo();
  rig.mark(1);
  return rig;
}

describe("a viewer", () => {
  test("asks, offers, and knows a picture's age by the car's clock", async () => {
    const rig = await seeing();
    assert.deepEqual(rig.peer.answers, ["v=0"]);
    // The clock's answer may have been on its way for the whole round trip: 10 ms more than half of it.
    assert.deepEqual(rig.sight.sighted(), { way: "webrtc", number: 1, age_ms: 40, still_ms: 0 });
    assert.equal(rig.sight.terms?.max_age_ms, PICTURE_MAX_AGE_MS);
    rig.tick(70);
    assert.deepEqual(rig.sight.sighted(), { way: "webrtc", number: 1, age_ms: 110, still_ms: 70 });
    await rig.pass(VIEW_RENEW_S * 1000);
    assert.ok(rig.count("keep") >= 1);
    assert.equal(rig.newest("keep").viewer, rig.newest("offer").viewer);
  });

  test("has no age before the clock is known", async () => {
    const rig = new Rig();
    await rig.terms();
    rig.mark(1);
    assert.equal(rig.sight.sighted()?.age_ms, undefined);
  });

  test("takes no picture for younger than it can prove", async () => {
    const rig = new Rig();
    await rig.terms();
    rig.peer.ends.open();
    // The question arrived at once, its answer and all pictures take 800 ms.
    const asked_ms = rig.now_ms;
    rig.echo(800);
    rig.mark(1, 800);
    assert.equal(rig.now_ms - asked_ms, 800);
    assert.equal(rig.sight.sighted()?.age_ms, 800);
  });

  test("believes no picture of the future, and none that stands still", async () => {
    const rig = await seeing();
    // The car's clock is set forward by a minute, and says so a second later.
    rig.mark(2, -60_000);
    assert.equal(rig.sight.sighted()?.age_ms, undefined);
    rig.now_ms += 60_100;
    assert.ok(rig.sight.sighted()!.age_ms! >= 60_100);
    for (const captured_ms of [-(2 ** 52), 2 ** 52]) {
      rig.mark(3, captured_ms);
      assert.ok((rig.sight.sighted()?.age_ms ?? Infinity) > PICTURE_MAX_AGE_MS, `${captured_ms}`);
    }
  });

  test("tries WebRTC anew if it shows nothing while small pictures come", async () => {
    const rig = await seeing();
    const come = async (from: number): Promise<void> => {
      for (let number = from; number < from + 40; number += 1) {
        await rig.pass(200);
        await rig.picture(number, 40, 20);
      }
    };
    await come(100);
    assert.equal(rig.peers[0]!.closed, false);
    await come(200);
    assert.ok(rig.peers[0]!.closed);
    assert.equal(rig.peers.length, 2);
    assert.equal(rig.sight.sighted()?.way, "broker");
  });

  test("has small pictures if a server's address is none", async () => {
    const rig = new Rig();
    rig.refuses = new Error("turn: has no user name");
    await rig.terms();
    rig.tick();
    assert.equal(rig.sight.otherwise, "Error: turn: has no user name");
    assert.equal(rig.count("pictures"), 1);
    await rig.pass(1_000);
    assert.equal(rig.asked, 1);
    // It is tried again later.
    rig.refuses = undefined;
    await rig.pass(5_000);
    assert.equal(rig.count("offer"), 1);
  });

  test("takes an answer once, and only to its newest request", async () => {
    const rig = new Rig();
    await rig.terms();
    const { viewer, request } = rig.newest("offer");
    const answer = { v: 1, kind: "answer", sdp: "v=0 forged" };
    rig.sight.hear(TOPICS.answer(viewer!), json({ ...answer, request: rig.newest("ask").request }));
    rig.sight.hear(TOPICS.answer("f".repeat(16)), json({ ...answer, request }));
    rig.sight.hear(TOPICS.look, json({ ...answer, request }));
    assert.deepEqual(rig.peer.answers, []);
    rig.say("offer", { kind: "answer", sdp: "v=0 good" });
    rig.say("offer", { kind: "answer", sdp: "v=0 again" });
    assert.deepEqual(rig.peer.answers, ["v=0 good"]);
    // An older request's terms change nothing.
    const before = rig.newest("ask");
    await rig.pass(VIEW_RENEW_S * 1000 + 200);
    rig.sight.hear(
      TOPICS.answer(before.viewer!),
      json({ v: 1, kind: "refused", why: "replayed", request: before.request }),
    );
    assert.ok(rig.sight.terms);
  });

  test("asks again while the car does not answer, and says so", async () => {
    const rig = new Rig();
    await rig.pass(10_000);
    assert.ok(rig.count("ask") >= 3);
    assert.equal(rig.sight.words, "The car does not answer");
    rig.say("ask", { kind: "refused", why: "the camera is unplugged" });
    assert.equal(rig.sight.words, "the camera is unplugged");
    await rig.terms();
  });

  test("asks for the deployment's relays before each offer, and tells the car of them", async () => {
    const rig = new Rig();
    const relay = (credential: string): IceServer => ({
      urls: ["turn:a.example"],
      username: "u",
      credential,
    });
    const own = { urls: ["stun:car.example"], username: "", credential: "" };
    rig.servers = async () => [relay(`${rig.given.length}`)];
    rig.say("ask", { kind: "terms", terms: TERMS, ice_servers: [own] });
    rig.tick();
    rig.tick();
    await rig.settled();
    rig.peer.ends.failed("the connection failed");
    await rig.pass(5_200);
    assert.deepEqual(rig.given, [
      [relay("0"), own],
      [relay("1"), own],
    ]);
    assert.deepEqual(rig.newest("offer").ice_servers, [relay("1")]);
  });

  test("offers without relays if there are none now", async () => {
    const rig = new Rig();
    rig.servers = () => Promise.reject(new Error("no relay for video"));
    await rig.terms();
    assert.deepEqual(rig.given, [[]]);
    assert.equal(rig.newest("offer").ice_servers, undefined);
  });

  for (const [what, happens] of Object.entries({
    "no picture comes": (rig: Rig) => rig.pass(CONNECT_MS + 200),
    "the offer is refused": async (rig: Rig) => rig.say("offer", { kind: "refused", why: "full" }),
    "the connection fails": async (rig: Rig) => rig.peer.ends.failed("the connection failed"),
    "the browser does not tell the picture": async (rig: Rig) => rig.peer.ends.shown(undefined),
  }))
    test(`has small pictures if ${what}, and WebRTC is tried again`, async () => {
      const rig = new Rig();
      await rig.terms();
      await happens(rig);
      rig.tick();
      assert.ok(rig.peer.closed);
      assert.equal(rig.newest("end").viewer, rig.newest("offer").viewer);
      assert.ok(rig.heard.has(TOPICS.picture));
      assert.equal(rig.newest("pictures").viewer, rig.newest("ask").viewer);
      // A message that is no picture is none.
      rig.sight.hear(TOPICS.picture, bytes("04ff"));
      assert.equal(rig.sight.sighted(), undefined);
      await rig.picture(8, 50, 20);
      // Its way took the whole round trip over the broker at most, 40 ms and not 20.
      assert.deepEqual(rig.sight.sighted(), { way: "broker", number: 8, age_ms: 70, still_ms: 0 });
      // An older one that comes again is not shown.
      await rig.picture(7, 500, 20);
      assert.equal(rig.sight.sighted()?.number, 8);
      const again = what === "the browser does not tell the picture" ? 0 : 1;
      await rig.pass(5_200);
      assert.equal(rig.peers.length, 1 + again);
      if (again === 0) return;
      rig.say("offer", { kind: "answer", sdp: "v=0" });
      rig.peer.ends.open();
      rig.echo();
      rig.mark(90);
      assert.equal(rig.sight.sighted()?.way, "webrtc");
      rig.tick();
      assert.equal(rig.newest("end").viewer, rig.newest("ask").viewer);
      assert.ok(!rig.heard.has(TOPICS.picture));
    });

  test("without WebRTC has small pictures at once", async () => {
    const rig = new Rig(false);
    await rig.terms();
    assert.equal(rig.count("offer"), 0);
    assert.equal(rig.count("pictures"), 1);
    await rig.picture(1, 40, 20);
    assert.equal(rig.sight.sighted()?.way, "broker");
    // They stopped: they are asked for again, and the age grows.
    await rig.pass(3_500);
    assert.equal(rig.count("pictures"), 2);
    assert.ok(rig.sight.sighted()!.age_ms! > 3_500);
    // The car's clock was set back, or somebody replays: what comes is shown with its age.
    await rig.picture(2, 7_000, 20);
    assert.deepEqual([rig.sight.sighted()?.number, rig.sight.sighted()?.age_ms], [2, 7_020]);
  });

  test("has small pictures while WebRTC stands still, and WebRTC's once it goes on", async () => {
    const rig = await seeing();
    await rig.pass(5_300);
    assert.equal(rig.count("pictures"), 1);
    assert.equal(rig.sight.sighted()?.number, 1);
    await rig.picture(70, 40, 20);
    assert.deepEqual([rig.sight.sighted()?.way, rig.sight.sighted()?.number], ["broker", 70]);
    assert.ok(!rig.peer.closed);
    rig.mark(90);
    assert.equal(rig.sight.sighted()?.way, "webrtc");
  });

  test("begins again when the car says that it is over", async () => {
    const rig = await seeing();
    await rig.pass(VIEW_RENEW_S * 1000 + 200);
    rig.say("keep", { kind: "ended", why: "it was over already" });
    assert.ok(rig.peer.closed);
    assert.equal(rig.sight.otherwise, "it was over already");
    await rig.pass(5_500);
    assert.equal(rig.peers.length, 2);
  });

  test("renews at once when the broker is back, and ends all when it closes", async () => {
    const rig = await seeing();
    const before = rig.count("keep");
    rig.sight.connected("The broker's connection ended");
    await rig.pass(VIEW_RENEW_S * 2000);
    assert.equal(rig.count("keep"), before);
    rig.mark(200);
    rig.sight.connected("");
    rig.tick();
    assert.equal(rig.newest("keep").viewer, rig.newest("offer").viewer);
    assert.deepEqual(
      rig.sight.heard().sort(),
      [...new Set([rig.newest("ask"), rig.newest("offer")])]
        .map(({ viewer }) => TOPICS.answer(viewer!))
        .sort(),
    );
    rig.sight.close();
    assert.ok(rig.peer.closed);
    assert.equal(rig.newest("end").viewer, rig.newest("offer").viewer);
    rig.say("offer", { kind: "answer", sdp: "v=0 late" });
    assert.deepEqual(rig.peer.answers, ["v=0"]);
  });
});
