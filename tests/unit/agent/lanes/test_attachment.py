"""Attachments: bytes become files, and the sample says which."""

from __future__ import annotations

import base64
import hashlib
import io
import threading
from pathlib import Path

import pytest
from PIL import Image

from iort_agent.config import load_config
from iort_agent.errors import ConfigError
from iort_agent.files.folder import FilesConfig, Folder
from iort_agent.lanes.attachment import Attachments, thumbnail
from iort_agent.sources.recording import BagConfig
from iort_contract.limits import MAX_PUBNUB_BYTES, MessageError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch
from iort_contract.messages.files import ATTACHMENT_AT, ATTACHMENT_FIELDS, file_key
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.ros.decode import Decoder, Large
from iort_contract.ros.definition import parse
from iort_contract.ros.message import Messages, RosMessage, RosType, filled
from testkit.agent import ManualClock
from tests.images import TOPIC, jpeg, write_bag
from tests.unit.contract.ros.ros1_messages import HEADER, text, u32

T_US = 1_700_000_000_123_456
PICTURE = jpeg()


def attachments_in(folder, *, every_s=1.0, max_bytes=10**9, small=lambda _content, _kind: "small"):
    files = FilesConfig(large_every_s=every_s, large_max_mb=max_bytes / 1e6)
    return Attachments("car", folder, files, ManualClock(), stored=lambda: None, thumbnail=small)


IMAGE = RosType("/camera", "sensor_msgs/CompressedImage", "1", "string format\nuint8[] data\nuint8 last")


def image(content=PICTURE):
    """A message with a content between other fields."""
    raw = text("jpeg") + u32(len(content)) + content + b"\7"
    return RosMessage(raw, IMAGE, large={"data": Large(content, len(text("jpeg")))})


def test_the_attachment_names_the_key_of_the_upload(tmp_path):
    attachments = attachments_in(tmp_path)
    sample = attachments.attach_to_message("camera", T_US, image())
    assert sample.keys() == {
        "format",
        "last",
        *(f"data.{name}" for name in (*ATTACHMENT_FIELDS, ATTACHMENT_AT)),
    }
    assert (sample["format"], sample["last"]) == ("jpeg", 7)
    assert sample["data.sha256"] == hashlib.sha256(PICTURE).hexdigest()
    assert (sample["data.size"], sample["data.content_type"]) == (len(PICTURE), "image/jpeg")
    # The folder does not know the attachment, and computes the same key.
    folder = Folder(tmp_path, clock=ManualClock(), settle_s=0, remove_after_s=0)
    name = folder.next()
    assert name == Path(f"camera/{T_US}-data.jpg")
    local = folder.local(name, threading.Event())
    assert file_key("car", local.file) == sample["data.key"]
    assert local.file.kind == "image"
    assert (tmp_path / name).read_bytes() == PICTURE


def test_other_content_is_kept_unchanged(tmp_path):
    sample = attachments_in(tmp_path, small=thumbnail).attach_to_message("scan", T_US, image(b"\0\1\2"))
    assert sample["data.content_type"] == "application/octet-stream"
    assert sample["data.thumbnail"] is None
    assert sample["data.key"].endswith(f"/scan/{T_US}-data.bin")
    assert sample["last"] == 7


@pytest.mark.parametrize("every_s", [0, 10**6], ids=["kept", "left out"])
def test_a_message_is_restored_with_its_contents(tmp_path, every_s):
    """Even if a content equals another one or another part of the message."""
    definition = "uint8[] a\nstring s\nuint8[] b\nuint8[] c\nuint8[] d"
    kind = RosType("/t", "a_msgs/A", "1", definition)
    contents = {"a": b"xy", "b": b"xy", "c": b"jpeg", "d": PICTURE}
    a, b, c, d = (u32(len(content)) + content for content in contents.values())
    raw = a + text("jpeg") + b + c + d
    values = Decoder(parse("a_msgs/A", definition), large=True).decode(raw)
    message = RosMessage(raw, kind, large={name: values[name] for name in contents})
    attachments = attachments_in(tmp_path, every_s=every_s)
    attachments.attach_to_message("s", T_US, RosMessage(u32(1) + b"z", kind, large={"a": Large(b"z", 0)}))
    sample = attachments.attach_to_message("s", T_US + 1, message)
    assert len(sample.raw) == len(message.raw) - sum(map(len, contents.values()))
    raw = sample.raw
    for name, content in reversed(contents.items()):
        raw = filled(raw, content, sample[f"{name}.at"])
    assert raw == message.raw
    assert [sample[f"{name}.key"] is not None for name in contents] == [not every_s] * 4
    with pytest.raises(MessageError, match="no empty array at byte 1"):
        filled(message.raw, b"", 1)


def test_selected_fields_can_be_attached(tmp_path):
    out = []
    attachments = attachments_in(tmp_path)
    emit = attachments.around(lambda *sample, more: out.append(sample))
    emit("camera", T_US, {"format": "jpeg", "data": PICTURE})
    ((_, _, sample),) = out
    assert sample.keys() == {"format", *(f"data.{name}" for name in ATTACHMENT_FIELDS)}
    assert sample["data.sha256"] == hashlib.sha256(PICTURE).hexdigest()
    assert attachments.report() == {"kept": 1, "not_due": 0, "left_out": 0}


def test_contents_are_limited_in_rate_and_the_fields_stay_the_same(tmp_path):
    attachments = attachments_in(tmp_path, every_s=1.0)
    samples = [attachments.attach_to_message("camera", T_US + i * 250_000, image()) for i in range(9)]
    assert [sample["data.key"] is not None for sample in samples] == [i % 4 == 0 for i in range(9)]
    assert {tuple(sample.beside) for sample in samples} == {
        tuple(f"data.{name}" for name in (*ATTACHMENT_FIELDS, ATTACHMENT_AT))
    }
    assert attachments.report() == {"kept": 3, "not_due": 6, "left_out": 0}
    # Other streams have their own rate, and a recording that starts again is due.
    assert attachments.attach_to_message("rear", T_US, image())["data.key"]
    assert attachments.attach_to_message("camera", T_US, image())["data.key"]


def test_a_full_folder_keeps_nothing_until_it_has_room(tmp_path):
    attachments = attachments_in(tmp_path, every_s=0, max_bytes=int(2.5 * len(PICTURE)))
    kept = [attachments.attach_to_message("camera", T_US + i, image())["data.key"] for i in range(3)]
    assert [key is not None for key in kept] == [True, True, False]
    assert attachments.report() == {"kept": 2, "not_due": 0, "left_out": 1, "full": 1}
    # A new run counts the files that wait.
    assert (
        attachments_in(tmp_path, max_bytes=int(2.5 * len(PICTURE))).attach_to_message(
            "camera", T_US, image()
        )["data.key"]
        is None
    )
    next(tmp_path.glob("camera/*.jpg")).unlink()
    assert attachments.attach_to_message("camera", T_US + 9, image())["data.key"]


def test_a_failing_disk_loses_the_content_and_keeps_the_sample(tmp_path):
    (tmp_path / "camera").write_text("in the way")
    attachments = attachments_in(tmp_path)
    sample = attachments.attach_to_message("camera", T_US, image())
    assert sample["data.key"] is None
    assert sample["format"] == "jpeg"
    assert attachments.report()["disk"] == 1


def test_waiting_for_the_folder_to_be_uploaded(tmp_path):
    attachments = attachments_in(tmp_path)
    assert attachments.wait_empty(0)
    attachments.attach_to_message("camera", T_US, image())
    assert not attachments.wait_empty(5)
    next(tmp_path.glob("camera/*.jpg")).unlink()
    assert attachments.wait_empty(5)


def test_only_bytes_are_attached(tmp_path):
    out = []
    emit = attachments_in(tmp_path).around(lambda *sample, more: out.append(sample))
    values = {"speed": 1.0, "text": "b"}
    emit("vesc", T_US, values)
    emit("camera", T_US, message := RosMessage(image(b"").raw, IMAGE))
    assert out == [("vesc", T_US, values), ("camera", T_US, message)]
    assert out[1][2] is message
    assert not list(tmp_path.iterdir())


def test_an_attachment_fits_a_batch_and_a_live_message(tmp_path):
    sample = attachments_in(tmp_path, small=thumbnail).attach_to_message("camera", T_US, image())
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
def test_content_that_is_no_picture_has_no_thumbnail(content, content_type):
    assert thumbnail(content, content_type) is None


def test_a_content_whose_bytes_are_in_the_stamp_too_is_cut_out_of_its_array(tmp_path):
    kind = RosType("/t", "a_msgs/A", "1", "Header header\nuint8[] data\nuint8 last" + HEADER)
    raw = u32(1, 1, 0x99) + text("car") + u32(1) + b"\x99" + b"\7"
    large = {"data": Large(b"\x99", len(raw) - 6)}
    sample = attachments_in(tmp_path).attach_to_message("s", T_US, RosMessage(raw, kind, large=large))
    assert (sample["last"], sample["data.at"]) == (7, len(raw) - 6)
    assert sample.raw == u32(1, 1, 0x99) + text("car") + u32(0) + b"\7"


# --- sources ----------------------------------------------------------------------------------------


def play(path, **settings):
    out = []
    source = BagConfig(path=path, topics=((TOPIC, "camera"),), **settings).build(ManualClock())
    source.run(lambda *sample: out.append(sample), threading.Event())
    # Without the stream of message types.
    return [sample for sample in out if sample[0] == "camera"]


def test_a_recording_gives_its_pictures_with_large_upload(tmp_path):
    path = write_bag(tmp_path / "camera.bag", [PICTURE, jpeg(1)])
    samples = play(path, large="upload")
    assert [values.large for _, _, values in samples] == [{"data": PICTURE}, {"data": jpeg(1)}]
    assert samples[0][2]["format"] == "jpeg"
    # Otherwise they stay in their messages.
    assert [PICTURE in values.raw for _, _, values in play(path)] == [True, False]
    assert [values.large for _, _, values in play(path)] == [{}, {}]


CAR = """
robot: car
endpoint: localhost
certificate: car.yaml
private_key: car.yaml
sources:
- type: ros1
  topics: {/camera/compressed: {stream: camera, time: header, large: upload}}
"""


def test_large_upload_needs_a_large_folder(tmp_path):
    file = tmp_path / "car.yaml"
    file.write_text(CAR)
    with pytest.raises(ConfigError, match=r"files.large_folder: required, and missing"):
        load_config(file)
    file.write_text(f"{CAR}\nfiles: {{large_folder: large}}\n")
    assert load_config(file).files.large_folder == tmp_path / "large"
    file.write_text(CAR.replace("upload", "download"))
    with pytest.raises(ConfigError, match="one of refuse, upload"):
        load_config(file)
