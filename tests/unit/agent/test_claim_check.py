"""The claim check: bytes become files, and the sample says which."""

from __future__ import annotations

import base64
import hashlib
import io
import struct
import threading
from pathlib import Path

import pytest
from PIL import Image

from iort_agent.config.file import load_config
from iort_agent.errors import ConfigError
from iort_agent.files.file import read
from iort_agent.files.folder import Folder
from iort_agent.lanes.attachment import ClaimCheck
from iort_agent.lanes.thumbnail import thumbnail
from iort_agent.sources.recording.bag import BagConfig
from iort_contract.limits import MAX_PUBNUB_BYTES, MessageError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch
from iort_contract.messages.files import CLAIM_AT, CLAIM_FIELDS, file_key
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.ros1.decode import Decoder
from iort_contract.ros1.definition import parse
from iort_contract.ros1.message import Messages, RosMessage, RosType, filled
from tests.agent_fakes import ManualClock
from tests.images import TOPIC, jpeg, write_bag
from tests.unit.contract.ros1_messages import text, u32

T_US = 1_700_000_000_123_456
PICTURE = jpeg()


def claims_in(folder, *, every_s=1.0, max_bytes=10**9, small=lambda _content, _kind: "small"):
    return ClaimCheck(
        robot="car",
        folder=folder,
        every_s=every_s,
        max_bytes=max_bytes,
        clock=ManualClock(),
        thumbnail=small,
        stored=lambda: None,
    )


IMAGE = RosType("/camera", "sensor_msgs/CompressedImage", "1", "string format\nuint8[] data\nuint8 last")


def image(content=PICTURE):
    """A message with a content, and other fields around it."""
    raw = text("jpeg") + u32(len(content)) + content + b"\7"
    return RosMessage(raw, IMAGE, large={"data": content})


def test_the_claim_says_where_the_upload_will_put_it(tmp_path):
    claims = claims_in(tmp_path)
    sample = claims.claim("camera", T_US, image())
    assert sample.keys() == {"format", "last", *(f"data.{name}" for name in (*CLAIM_FIELDS, CLAIM_AT))}
    assert (sample["format"], sample["last"]) == ("jpeg", 7)
    assert sample["data.sha256"] == hashlib.sha256(PICTURE).hexdigest()
    assert (sample["data.size"], sample["data.content_type"]) == (len(PICTURE), "image/jpeg")
    # The folder's own thread knows nothing of the claim, and comes to the same key.
    folder = Folder(tmp_path, clock=ManualClock(), settle_s=0, remove_after_s=0)
    name = folder.next()
    assert name == Path(f"camera/{T_US}-data.jpg")
    local = folder.local(name, threading.Event())
    assert file_key("car", local.file) == sample["data.key"]
    assert local.file.kind == "image"
    assert (tmp_path / name).read_bytes() == PICTURE


def test_what_is_no_picture_is_kept_as_it_is(tmp_path):
    sample = claims_in(tmp_path, small=thumbnail).claim("scan", T_US, image(b"\0\1\2"))
    assert sample["data.content_type"] == "application/octet-stream"
    assert sample["data.thumbnail"] is None
    assert sample["data.key"].endswith(f"/scan/{T_US}-data.bin")
    assert sample["last"] == 7


@pytest.mark.parametrize("every_s", [0, 10**6], ids=["kept", "left out"])
def test_a_message_is_whole_again_with_its_contents(tmp_path, every_s):
    """Also where a content is like another one, or like what else is in the message."""
    kind = RosType("/t", "a_msgs/A", "1", "uint8[] a\nstring s\nuint8[] b\nuint8[] c\nuint8[] d")
    contents = {"a": b"xy", "b": b"xy", "c": b"jpeg", "d": PICTURE}
    a, b, c, d = (u32(len(content)) + content for content in contents.values())
    message = RosMessage(a + text("jpeg") + b + c + d, kind, large=contents)
    claims = claims_in(tmp_path, every_s=every_s)
    claims.claim("s", T_US, RosMessage(u32(1) + b"z", kind, large={"a": b"z"}))
    sample = claims.claim("s", T_US + 1, message)
    assert len(sample.raw) == len(message.raw) - sum(map(len, contents.values()))
    raw = sample.raw
    for name, content in reversed(contents.items()):
        raw = filled(raw, content, sample[f"{name}.at"])
    assert raw == message.raw
    assert [sample[f"{name}.key"] is not None for name in contents] == [not every_s] * 4
    with pytest.raises(MessageError, match="no empty array at byte 1"):
        filled(message.raw, b"", 1)


def test_a_content_of_selected_fields_is_claimed_too(tmp_path):
    out = []
    claims = claims_in(tmp_path)
    emit = claims.around(lambda *sample: out.append(sample))
    emit("camera", T_US, {"format": "jpeg", "data": PICTURE})
    ((_, _, sample),) = out
    assert sample.keys() == {"format", *(f"data.{name}" for name in CLAIM_FIELDS)}
    assert sample["data.sha256"] == hashlib.sha256(PICTURE).hexdigest()
    assert claims.report() == {"kept": 1, "not_due": 0, "left_out": 0}


def test_at_most_one_content_in_so_long_and_the_fields_stay_the_same(tmp_path):
    claims = claims_in(tmp_path, every_s=1.0)
    samples = [claims.claim("camera", T_US + i * 250_000, image()) for i in range(9)]
    assert [sample["data.key"] is not None for sample in samples] == [i % 4 == 0 for i in range(9)]
    assert {tuple(sample.beside) for sample in samples} == {
        tuple(f"data.{name}" for name in (*CLAIM_FIELDS, CLAIM_AT))
    }
    assert claims.report() == {"kept": 3, "not_due": 6, "left_out": 0}
    # Another stream has its own turn, and a recording that begins anew does too.
    assert claims.claim("rear", T_US, image())["data.key"]
    assert claims.claim("camera", T_US, image())["data.key"]


def test_a_full_folder_keeps_nothing_more_until_there_is_room(tmp_path):
    claims = claims_in(tmp_path, every_s=0, max_bytes=int(2.5 * len(PICTURE)))
    kept = [claims.claim("camera", T_US + i, image())["data.key"] for i in range(3)]
    assert [key is not None for key in kept] == [True, True, False]
    assert claims.report() == {"kept": 2, "not_due": 0, "left_out": 1, "full": 1}
    # Another run finds what waits.
    assert (
        claims_in(tmp_path, max_bytes=int(2.5 * len(PICTURE))).claim("camera", T_US, image())["data.key"]
        is None
    )
    next(tmp_path.glob("camera/*.jpg")).unlink()
    assert claims.claim("camera", T_US + 9, image())["data.key"]


def test_a_disk_that_fails_costs_the_content_and_not_the_sample(tmp_path):
    (tmp_path / "camera").write_text("in the way")
    claims = claims_in(tmp_path)
    sample = claims.claim("camera", T_US, image())
    assert sample["data.key"] is None
    assert sample["format"] == "jpeg"
    assert claims.report()["disk"] == 1


def test_waiting_for_the_folder_to_be_uploaded(tmp_path):
    claims = claims_in(tmp_path)
    assert claims.wait_empty(0)
    claims.claim("camera", T_US, image())
    assert not claims.wait_empty(5)
    next(tmp_path.glob("camera/*.jpg")).unlink()
    assert claims.wait_empty(5)


def test_only_bytes_are_claimed(tmp_path):
    out = []
    emit = claims_in(tmp_path).around(lambda *sample: out.append(sample))
    values = {"speed": 1.0, "text": "b"}
    emit("vesc", T_US, values)
    emit("camera", T_US, message := RosMessage(image(b"").raw, IMAGE))
    assert out == [("vesc", T_US, values), ("camera", T_US, message)]
    assert out[1][2] is message
    assert not list(tmp_path.iterdir())


def test_a_claim_fits_a_batch_and_the_live_lane(tmp_path):
    sample = claims_in(tmp_path, small=thumbnail).claim("camera", T_US, image())
    columns = {name: [value] for name, value in sample.beside.items()}
    messages = Messages(IMAGE.id, IMAGE.layout, [sample.raw])
    batch = Batch("0123456789abcdef", 0, [T_US], columns, 0, messages)
    assert len(encode_batch(batch)) < 8000
    assert decode_batch(encode_batch(batch)).columns == {name: [sample[name]] for name in sample}
    live = LiveSample("0123456789abcdef", 0, T_US, T_US, sample)
    assert len(encode_live(live)) < MAX_PUBNUB_BYTES / 2


# --- thumbnails -------------------------------------------------------------------------------------


def test_a_thumbnail_is_a_small_picture_of_the_same_shape():
    small = thumbnail(PICTURE, "image/jpeg")
    assert small is not None
    assert len(small) <= 4096
    with Image.open(io.BytesIO(base64.b64decode(small))) as picture:
        assert (picture.format, picture.size) == ("JPEG", (96, 72))


@pytest.mark.parametrize(
    ("content", "content_type"),
    [
        (b"", "image/jpeg"),
        (PICTURE[:500], "image/jpeg"),
        (b"\xff\xd8\xffnoise", "image/png"),
        (PICTURE, "text/plain"),
    ],
)
def test_what_cannot_be_shown_has_no_thumbnail(content, content_type):
    assert thumbnail(content, content_type) is None


# --- sources ----------------------------------------------------------------------------------------


def play(path, **settings):
    out = []
    source = BagConfig(path=path, topics=((TOPIC, "camera"),), **settings).build(ManualClock())
    source.run(lambda *sample: out.append(sample), threading.Event())
    # Without what says what the messages are.
    return [sample for sample in out if sample[0] == "camera"]


def test_a_recordings_pictures_are_handed_over_where_it_says_upload(tmp_path):
    path = write_bag(tmp_path / "camera.bag", [PICTURE, jpeg(1)])
    samples = play(path, large="upload")
    assert [values.large for _, _, values in samples] == [{"data": PICTURE}, {"data": jpeg(1)}]
    assert samples[0][2]["format"] == "jpeg"
    # Otherwise they stay in their messages, as large as those are.
    assert [PICTURE in values.raw for _, _, values in play(path)] == [True, False]
    assert [values.large for _, _, values in play(path)] == [{}, {}]


def test_a_live_topics_bytes_are_handed_over_where_it_says_upload():
    definition = parse("sensor_msgs/CompressedImage", "string format\nuint8[] data\nuint8 last")
    message = struct.pack("<I4sI", 4, b"jpeg", len(PICTURE)) + PICTURE + b"\x07"
    values = Decoder(definition, large=True).decode(message)
    assert values == {"format": "jpeg", "data": PICTURE, "last": 7}
    refusing = Decoder(definition)
    assert refusing.decode(message) == {"format": "jpeg", "last": 7}
    assert refusing.left_out == {"data": 1}
    assert Decoder(definition, select=["format"], large=True).decode(message) == {"format": "jpeg"}
    with pytest.raises(MessageError, match="truncated"):
        Decoder(definition, large=True).decode(message[:100])


CAR = """
robot: car
endpoint: localhost
certificate: car.yaml
private_key: car.yaml
sources:
- type: ros1
  topics: {/camera/compressed: {stream: camera, time: header, large: upload}}
"""


def test_where_bytes_wait_must_be_said(tmp_path):
    file = tmp_path / "car.yaml"
    file.write_text(CAR)
    with pytest.raises(ConfigError, match=r"files.large_folder: required, and missing"):
        load_config(file)
    file.write_text(f"{CAR}\nfiles: {{large_folder: large}}\n")
    assert load_config(file).files.large_folder == tmp_path / "large"
    file.write_text(CAR.replace("upload", "download"))
    with pytest.raises(ConfigError, match="one of refuse, upload"):
        load_config(file)


def test_what_the_folder_has_read_is_what_the_claim_says(tmp_path):
    claims_in(tmp_path).claim("camera", T_US, image())
    (path,) = tmp_path.glob("camera/*.jpg")
    local = read(tmp_path, path.relative_to(tmp_path), stop=threading.Event())
    assert local.file.t_us == T_US
