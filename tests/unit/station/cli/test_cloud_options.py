"""Errors for a newcomer without an account, without a region or without a deployment."""

from __future__ import annotations

import fcntl
import os
import re
from urllib.request import proxy_bypass

import pytest
from typer.testing import CliRunner

from iort_station import kept
from iort_station.cli.main import app, said
from iort_station.cli.options import CloudOptions
from iort_station.cloud import EMBEDDED, Cloud, find_embedded
from iort_station.errors import StationError
from iort_station.page.page import typed_keys


@pytest.fixture(autouse=True)
def newcomer(monkeypatch, tmp_path):
    """A machine without AWS settings in the environment and the home folder."""
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    # No cloud of `make up` either.
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "nowhere"))


@pytest.fixture
def found(tmp_path):
    def cloud(**options):
        given = {"namespace": "iort", "profile": None, "region": None, "local": False, **options}
        return CloudOptions(**given, embedded=tmp_path / "cloud.json").cloud()

    return cloud


def test_the_error_without_any_cloud_names_both_ways(found):
    with pytest.raises(StationError, match=r"no AWS region.*AWS_REGION.*`make demo`"):
        found()


def test_an_embedded_cloud_is_found_from_any_folder_of_its_checkout(tmp_path):
    inside = tmp_path / "checkout" / "docs" / "examples"
    inside.mkdir(parents=True)
    assert find_embedded(inside) is None
    described = tmp_path / "checkout" / "build" / "local" / "cloud.json"
    described.parent.mkdir(parents=True)
    described.touch()
    assert find_embedded(inside) == find_embedded(tmp_path / "checkout") == described
    assert find_embedded(tmp_path) is None


def test_the_doctor_looks_at_a_stopped_cloud_where_nothing_else_is_meant(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "no AWS region" in str(CliRunner().invoke(app, ["doctor"]).exception)
    kept.folder().mkdir(parents=True)
    looked = CliRunner().invoke(app, ["doctor"])
    assert looked.exit_code == 1
    assert f"no cloud is up in {kept.folder()}" in looked.stdout.replace("\n", "")


def test_the_error_outside_a_checkout_says_how_to_name_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StationError, match=r"no embedded cloud is running.*IORT_EMBEDDED names its file"):
        CloudOptions("iort", None, None, local=True, embedded=None).cloud()


def test_outside_a_checkout_the_clouds_that_run_are_named(tmp_path, monkeypatch):
    """Every verb names them, and `Cloud.find` in a notebook; one that has ended is not named."""
    monkeypatch.chdir(tmp_path)
    running = tmp_path / "a checkout" / "cloud.json"
    running.parent.mkdir()
    Cloud(namespace="lab").save(running)
    advice = f"iort --embedded '{running}'"
    with kept.announced(running), kept.lock_of(running.parent).open("w") as lock:
        lock.write(str(os.getpid()))
        lock.flush()
        assert kept.running() == [], "it was killed: nobody has locked its folder"
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert advice in str(CliRunner().invoke(app, ["robots", "list"]).exception)
        with pytest.raises(StationError, match=re.escape(advice)):
            Cloud.find()
        assert Cloud.find(embedded=running).namespace == "lab"
        monkeypatch.setenv("IORT_EMBEDDED", str(running))
        assert Cloud.find().namespace == "lab"
        monkeypatch.delenv("IORT_EMBEDDED")
        running.unlink()
        assert kept.running() == [], "it was killed, and its folder removed"
    with pytest.raises(StationError, match="`make up` or `make demo` starts one"):
        Cloud.find()


def test_a_notebook_in_a_checkout_finds_its_cloud_as_the_command_does(tmp_path, monkeypatch):
    file = tmp_path / EMBEDDED
    file.parent.mkdir(parents=True)
    Cloud(namespace="lab").save(file)
    monkeypatch.chdir(tmp_path)
    said = []
    assert Cloud.find(say=said.append).namespace == "lab"
    assert said == [f"on the embedded cloud of {file}"]
    monkeypatch.setenv("AWS_REGION", "eu-west-1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "b")
    assert Cloud.find(say=said.append).namespace == "iort"
    assert said[1:] == ["on AWS, in eu-west-1"]


def test_a_backup_means_the_cloud_that_other_verbs_mean(tmp_path, monkeypatch):
    """In the folder of a demo it does not take the cloud of `make up` without a word."""
    file = tmp_path / EMBEDDED
    file.parent.mkdir(parents=True)
    Cloud(namespace="lab").save(file)
    monkeypatch.chdir(tmp_path)
    kept.folder().mkdir(parents=True)
    refused = str(CliRunner().invoke(app, ["backup", "cloud.tar"]).exception)
    assert f"the cloud here is that of {file}, which is thrown away" in refused
    assert str(kept.folder()) in refused
    named = CliRunner().invoke(app, ["backup", "cloud.tar", "--state", str(kept.folder())])
    assert f"of the cloud that is kept in {kept.folder()}" in named.stderr


def test_the_environment_names_an_embedded_cloud(tmp_path):
    named = {"IORT_EMBEDDED": str(tmp_path / "cloud.json")}
    done = CliRunner().invoke(app, ["--local", "robots", "list"], env=named)
    assert f"no embedded cloud is running: {tmp_path / 'cloud.json'} does not exist" in str(done.exception)


def test_a_region_without_credentials_is_an_error_with_advice(found, monkeypatch):
    with pytest.raises(StationError, match="no AWS credentials: give --profile") as raised:
        found(region="eu-west-1")
    assert "make demo" not in str(raised.value), "who names a region means AWS"
    monkeypatch.setenv("AWS_REGION", "eu-west-1")
    with pytest.raises(StationError, match="no AWS credentials"):
        found()


def test_an_unknown_profile_is_named(found):
    with pytest.raises(StationError, match="nobody"):
        found(profile="nobody")


def test_the_cdks_region_variable_is_read(found, monkeypatch):
    monkeypatch.setenv("AWS_REGION", "eu-central-1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "b")
    assert found().client("iot").meta.region_name == "eu-central-1"
    assert found(region="eu-west-1").client("iot").meta.region_name == "eu-west-1"


def test_an_embedded_cloud_ignores_the_profile(monkeypatch):
    monkeypatch.setenv("AWS_PROFILE", "nobody")
    embedded = Cloud(region="eu-west-1", access_key_id="test", secret_access_key="test")
    assert embedded.client("iot").meta.region_name == "eu-west-1"
    with pytest.raises(StationError, match="nobody"):
        Cloud(region="eu-west-1").check()


@pytest.mark.parametrize(
    ("name", "value"), [("NO_PROXY", "lab.example"), ("no_proxy", "lab.example"), (None, "")]
)
def test_requests_to_an_embedded_cloud_bypass_the_proxy(monkeypatch, tmp_path, name, value):
    for each in ("NO_PROXY", "no_proxy"):
        # Set first, so that monkeypatch restores the variable even if it did not exist.
        monkeypatch.setenv(each, "")
        monkeypatch.delenv(each)
    if name:
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("HTTPS_PROXY", "http://proxy.example:3128")
    Cloud(endpoint_url="https://127.0.0.1:4566").save(tmp_path / "cloud.json")
    for _ in range(2):
        Cloud.load(tmp_path / "cloud.json")
        assert (
            os.environ["no_proxy"] == os.environ["NO_PROXY"] == ",".join(filter(None, [value, "127.0.0.1"]))
        )
    assert proxy_bypass("127.0.0.1")
    assert not proxy_bypass("sts.amazonaws.com")


def test_keys_are_asked_for_only_after_the_cloud_is_found(tmp_path):
    done = CliRunner().invoke(app, ["--embedded", str(tmp_path / "cloud.json"), "pubnub"], input="a\nb\n")
    assert isinstance(done.exception, StationError)
    assert "key" not in done.output


@pytest.mark.parametrize(
    ("publish", "subscribe", "said"),
    [
        ("sub-c-1", "pub-c-1", "the publish key must be pub-c-..., as PubNub's admin portal shows it"),
        ("pub-c-1", "sec-c-1", "the subscribe key must be sub-c-..., as PubNub's admin portal shows it"),
        ("", "sub-c-1", "the publish key"),
    ],
)
def test_a_key_of_another_kind_is_refused_and_not_printed(publish, subscribe, said):
    with pytest.raises(StationError, match=said) as raised:
        typed_keys(publish, subscribe)
    assert "-c-1" not in str(raised.value)


def test_whitespace_around_a_typed_key_is_removed():
    typed = typed_keys(" pub-c-1", "sub-c-1\n")
    assert (typed.publish_key, typed.subscribe_key) == ("pub-c-1", "sub-c-1")


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(FileNotFoundError) as raised:
        (tmp_path / "no" / "ride.csv").write_text("")
    assert said(raised.value) == f"{tmp_path}/no/ride.csv: No such file or directory"
    assert said(OSError("of no file")) == "of no file"


def test_a_stack_that_is_not_deployed_is_named_with_its_region(aws):
    with pytest.raises(StationError, match=r"iort-storage is not deployed in eu-west-1: run `make deploy`"):
        Cloud().output("storage", "TelemetryTable")
