"""The operator's side of files, against moto: listing, downloading, deleting."""

from __future__ import annotations

import hashlib
import json
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from iort_contract.messages.files import File, file_key
from iort_station.cli.main import app
from iort_station.cli.options import CloudOptions
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import files
from testkit.dynamodb import FILES

# 2023-11-14T22:13:20Z
NOON = 1_700_000_000


class PagedS3:
    """moto's client with pages of two keys instead of a thousand; it counts the pages."""

    def __init__(self, client):
        self._client = client
        self.pages = 0
        self.deleted = 0

    def __getattr__(self, name):
        return getattr(self._client, name)

    def get_paginator(self, name):
        if name != "list_objects_v2":
            return self._client.get_paginator(name)
        pages = self._client.get_paginator(name)

        def paginate(**arguments):
            for page in pages.paginate(**arguments, PaginationConfig={"PageSize": 2}):
                self.pages += 1
                yield page

        return SimpleNamespace(paginate=paginate)


@pytest.fixture
def s3(s3):
    return PagedS3(s3)


@pytest.fixture
def cloud(s3, monkeypatch):
    made = Cloud(region="eu-west-1")
    made._clients["s3", None] = s3
    monkeypatch.setattr(
        Cloud, "output", lambda _self, noun, name: {("storage", "FilesBucket"): FILES}[noun, name]
    )
    return made


@pytest.fixture
def store(s3):
    """Puts a robot's file; the SHA-256 may be wrong."""

    def put(content=b"content", name="drive.bag", second=NOON, robot="car", sha256=None):
        digest = hashlib.sha256(content).hexdigest()
        file = File(name, "recording", "application/x-rosbag", len(content), digest, second * 1_000_000)
        key = file_key(robot, file)
        s3.put_object(Bucket=FILES, Key=key, Body=content, Metadata={"sha256": sha256 or digest})
        return key

    return put


def names(found):
    return [one.name for one in found]


def test_a_robots_files_are_listed_by_time_across_pages(cloud, store, s3):
    for i in (4, 0, 3, 1, 2):
        store(name=f"{i}.bag", second=NOON + i * 86_400)
    store(robot="car2", name="other.bag")
    s3.put_object(Bucket=FILES, Key="robots/car/by-hand.txt", Body=b"")
    s3.put_object(Bucket=FILES, Key="results/x", Body=b"")
    found = list(files.listed(cloud, "car"))
    assert names(found) == ["0.bag", "1.bag", "2.bag", "3.bag", "4.bag"]
    assert s3.pages == 3
    assert (found[0].second, found[0].size, found[0].robot) == (NOON, 7, "car")
    with pytest.raises(StationError, match="robot name"):
        list(files.listed(cloud, "../car"))


@pytest.mark.parametrize(
    ("start_s", "end_s", "expected"),
    [
        (None, None, "01234"),
        (NOON + 1, None, "1234"),
        (NOON, NOON + 1, "0"),
        (None, NOON + 86_400, "0"),
        (NOON + 86_400, NOON + 3 * 86_400, "12"),
        (NOON + 9 * 86_400, None, ""),
        (0, 5, ""),
    ],
)
def test_a_range_applies_to_the_files_times(cloud, store, start_s, end_s, expected):
    for i in range(5):
        store(name=f"{i}.bag", second=NOON + i * 86_400)
    start_us, end_us = (None if s is None else s * 1_000_000 for s in (start_s, end_s))
    found = files.listed(cloud, "car", start_us=start_us, end_us=end_us)
    assert names(found) == [f"{i}.bag" for i in expected]


def test_a_download_resumes_and_its_content_is_checked(cloud, store, tmp_path):
    content = bytes(range(256)) * 1000
    store(content, name="rosbag2_1/data.db3")
    (file,) = files.listed(cloud, "car")
    part = tmp_path / "rosbag2_1" / f"data.db3.{hashlib.sha256(content).hexdigest()[:12]}.part"
    part.parent.mkdir()
    part.write_bytes(content[:1000])
    heard = []
    path = files.download(cloud, file, tmp_path, heard.append)
    assert path == tmp_path / "rosbag2_1" / "data.db3"
    assert path.read_bytes() == content
    assert (heard[0], sum(heard)) == (1000, len(content))
    assert not part.exists()
    # A second download finds the file complete.
    assert files.download(cloud, file, tmp_path) == path
    path.write_bytes(b"mine")
    with pytest.raises(StationError, match="is another file"):
        files.download(cloud, file, tmp_path)
    assert path.read_bytes() == b"mine"


def test_an_empty_file_is_downloaded(cloud, store, tmp_path):
    store(b"")
    (file,) = files.listed(cloud, "car")
    assert files.download(cloud, file, tmp_path).read_bytes() == b""


def test_a_content_with_a_wrong_sha256_is_refused(cloud, store, tmp_path):
    store(b"evil", sha256="0" * 64)
    (file,) = files.listed(cloud, "car")
    with pytest.raises(StationError, match="SHA-256 must be"):
        files.download(cloud, file, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_damaged_part_is_detected_and_deleted(cloud, store, tmp_path):
    content = b"0123456789"
    store(content)
    (file,) = files.listed(cloud, "car")
    part = tmp_path / f"drive.bag.{hashlib.sha256(content).hexdigest()[:12]}.part"
    part.write_bytes(b"XX")
    with pytest.raises(StationError, match="SHA-256 must be"):
        files.download(cloud, file, tmp_path)
    assert files.download(cloud, file, tmp_path).read_bytes() == content


def test_empty_deletes_all_files(cloud, store, s3):
    for i in range(5):
        store(name=f"{i}.bag")
    s3.create_multipart_upload(Bucket=FILES, Key="robots/car/begun")
    gone = []
    files.empty(cloud, gone.append)
    assert sum(gone) == 6
    assert "Contents" not in s3.list_objects_v2(Bucket=FILES)
    assert "Uploads" not in s3.list_multipart_uploads(Bucket=FILES)


def test_empty_deletes_earlier_versions_too(cloud, store, s3):
    """As `prod` keeps them; CloudFormation deletes no bucket that has one."""
    s3.put_bucket_versioning(Bucket=FILES, VersioningConfiguration={"Status": "Enabled"})
    for content in (b"one", b"another"):
        s3.put_object(Bucket=FILES, Key="archive/hour.parquet", Body=content)
    s3.delete_object(Bucket=FILES, Key="archive/hour.parquet")
    assert not files.is_empty(cloud)
    files.empty(cloud)
    assert files.is_empty(cloud)


# --- the command ------------------------------------------------------------------------------------


@pytest.fixture
def iort(cloud, monkeypatch):
    monkeypatch.setattr(CloudOptions, "cloud", lambda _self: cloud)

    def run(*arguments, status=0, **how):
        done = CliRunner().invoke(app, ["files", *arguments], **how)
        if status == 0:
            assert done.exception is None, done.output
        return done

    return run


def test_list_prints_the_selected_files(iort, store):
    store(name="a.bag")
    key = store(name="b.txt", second=NOON + 1)
    assert iort("list", "car").output.splitlines()[0].split() == ["2023-11-14T22:13:20Z", "7", "a.bag"]
    (listed,) = json.loads(iort("list", "car", "--name", "*.txt", "--json").output)
    assert listed["key"] == key
    assert listed["written_us"] == (NOON + 1) * 1_000_000
    assert json.loads(iort("list", "car", "--name", "*.none", "--json").output) == []
    assert iort("list", "car", "--last", "1d").stdout == ""
    assert "give --last, or" in str(iort("list", "car", "--last", "1d", "--to", "now", status=1).exception)


def test_get_downloads_the_newest_file_or_all(iort, store, tmp_path):
    store(b"old", name="a.bag")
    store(b"new", name="a.bag", second=NOON + 1)
    store(b"other", name="b.bag", second=NOON + 2)
    iort("get", "car", "a.bag", "--out", str(tmp_path / "one"))
    assert (tmp_path / "one" / "a.bag").read_bytes() == b"new"
    done = iort("get", "car", "--out", str(tmp_path / "all"), "--json")
    paths = {json.loads(line)["path"] for line in done.output.splitlines()}
    assert paths == {
        str(tmp_path / "all" / folder / name)
        for folder, name in (
            ("20231114-221320", "a.bag"),
            ("20231114-221321", "a.bag"),
            ("20231114-221322", "b.bag"),
        )
    }
    assert "has no file c.bag" in str(iort("get", "car", "c.bag", status=1).exception)
    assert "no matching files" in str(iort("get", "car", "--name", "*.zip", status=1).exception)


def test_get_fetches_the_rest_of_the_files_if_one_is_damaged(iort, store, tmp_path):
    bad = store(b"first", name="a.bag", sha256="0" * 64)
    store(b"second", name="b.bag", second=NOON + 60)
    done = iort("get", "car", "--out", str(tmp_path), status=1)
    assert (tmp_path / "b.bag").read_bytes() == b"second"
    assert not (tmp_path / "a.bag").exists()
    assert f"{bad}: SHA-256 must be" in done.stderr
    assert "1 of 2 files could not be fetched" in str(done.exception)


def test_empty_asks_for_confirmation(iort, store, s3):
    store()
    assert "Nobody can answer here" in str(iort("empty", status=2).exception)
    assert s3.list_objects_v2(Bucket=FILES)["KeyCount"] == 1
    assert "1 deleted" in iort("empty", "--yes").output
    assert s3.list_objects_v2(Bucket=FILES)["KeyCount"] == 0
