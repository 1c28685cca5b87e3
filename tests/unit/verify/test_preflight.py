"""The preflight as a whole: without credentials, permissions or answers, and what it reports."""

from __future__ import annotations

import sys

import pytest
from botocore.exceptions import NoCredentialsError

from iort_station.cli.console import Console
from iort_station.errors import StationError
from stacks.settings import Settings, SettingsError
from tests.unit.verify.account import NEW, Account, Refused, denied, limits, settings, stack_answers
from verify.preflight import __main__ as preflight
from verify.preflight import account
from verify.preflight.deployed import derive
from verify.preflight.finding import Verdict

WARNING, STOPS = Verdict.WARNING, Verdict.STOPS


@pytest.mark.parametrize(
    "error",
    [
        Refused("InvalidClientTokenId", "The security token included in the request is invalid", 403),
        Refused("ExpiredToken", "The security token included in the request is expired", 403),
    ],
)
def test_only_the_credentials_are_asked_for_if_they_are_missing(error):
    account = Account(GetCallerIdentity=error)
    (finding,) = preflight.look(account, settings())
    assert (finding.item, finding.verdict) == ("credentials", STOPS)
    assert account.asked == ["GetCallerIdentity"]


@pytest.mark.parametrize("error", [NoCredentialsError(), StationError("no AWS client for sts: no region")])
def test_an_error_of_the_client_stops_the_preflight(error):
    class Nothing:
        def client(self, service):
            raise error

    (finding,) = preflight.look(Nothing(), settings())
    assert finding.verdict is STOPS
    assert str(error) in finding.found


EVERYTHING = {
    "site": True,
    "device_defender": True,
    "iot_log_level": "error",
    "stage": "prod",
    "turn": True,
}


def test_a_new_account_passes_and_is_only_read():
    account = Account()
    findings = preflight.look(account, settings(**EVERYTHING))
    assert len({finding.item for finding in findings}) == len(findings) == 13
    assert not preflight.stopped(findings)
    assert all(name.startswith(("Get", "List", "Describe")) for name in account.asked)


def test_a_missing_permission_is_a_warning_that_names_it():
    answers = {name: denied(f"service:{name}") for name in NEW if name != "GetCallerIdentity"}
    _, *findings = preflight.look(Account(**answers), settings(**EVERYTHING))
    assert len(findings) == 12
    for finding in findings:
        if finding.item == "spending":
            continue
        assert finding.verdict is WARNING
        assert finding.found.startswith("not answered: the permission service:")
        assert finding.do.startswith("allow service:")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (Refused("AccessDenied", "Access Denied", 403), "the permission GetParameter is missing"),
        (Refused("InternalServerError", "try later", 500), "try later"),
    ],
)
def test_an_unanswered_question_is_a_warning(error, text):
    finding = account.bootstrap(Account(GetParameter=error), settings())
    assert finding.verdict is WARNING
    assert text in finding.found


def test_a_report_has_every_finding_with_its_advice(capsys):
    findings = preflight.look(Account(GetParameter=Refused("ParameterNotFound")), settings())
    assert preflight.stopped(findings)
    preflight.show(findings, Console(file=sys.stdout, width=200))
    lines = capsys.readouterr().out.splitlines()
    at = lines.index("stops    bootstrap: this account and region are not bootstrapped")
    assert lines[at + 1] == "         -> `make bootstrap`, once"


def test_the_cdks_arguments_are_read_as_app_py_reads_them(tmp_path):
    asked = preflight.options(
        [
            "-c",
            "stage=prod",
            "--context",
            "budget_usd=50",
            "--context=alarm_email=a@b.org",
            "--require-approval",
            "never",
        ]
    )
    read = preflight.context([*asked.context, f"layer={tmp_path}", f"analysis_layer={tmp_path}"])
    made = Settings.read(read.get)
    assert (made.stage, made.budget_usd, made.alarm_email) == ("prod", 50, "a@b.org")
    with pytest.raises(SettingsError, match="stage must be"):
        Settings.read(preflight.context(["stage=test"]).get)


@pytest.mark.parametrize(
    ("given", "answer", "derived"),
    [
        ({}, limits(10, 10), {"account_concurrency": "10"}),
        ({}, limits(), {"account_concurrency": "1000"}),
        ({"account_concurrency": "50"}, limits(), {}),
        # The item about it says what is missing; the deployment has the limits of a new account.
        ({}, denied("lambda:GetAccountSettings"), {}),
    ],
)
def test_what_is_not_given_follows_from_the_account(given, answer, derived):
    given = {"live_transport": "iot", **given}
    assert derive(Account(GetAccountSettings=answer), given) == derived


STORED, DENIED = {"Parameter": {"Value": "x"}}, denied("ssm:GetParameter")


@pytest.mark.parametrize(
    ("given", "keys", "deployed", "derived"),
    [
        ({}, Refused("ParameterNotFound"), None, "iot"),
        ({}, STORED, None, "pubnub"),
        ({}, STORED, "iot", "pubnub"),
        ({}, Refused("ParameterNotFound"), "pubnub", "iot"),
        ({"live_transport": "iot"}, STORED, "pubnub", None),
        # Nobody may look: what is deployed stays, and the default is AWS IoT.
        ({}, DENIED, "pubnub", "pubnub"),
        ({}, DENIED, "iot", None),
        ({}, DENIED, None, None),
    ],
)
def test_live_messages_go_by_pubnub_where_its_keys_are_stored(given, keys, deployed, derived):
    there = (
        stack_answers({"fleet": "UPDATE_COMPLETE"}, outputs={"LiveTransport": deployed}) if deployed else {}
    )
    answers = derive(Account(GetParameter=keys, **there), {"account_concurrency": "10", **given})
    assert answers.get("live_transport") == derived
    # A public page needs its robots with AWS IoT only, so the settings are read with the answer.
    site = Settings(site=True, **answers)
    assert site.public == (derived != "pubnub")


def test_a_wrong_namespace_is_refused_before_the_account_is_asked(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["preflight", "-c", "namespace=No"])
    with pytest.raises(SystemExit, match="preflight: namespace must be"):
        preflight.main()


def test_a_deployment_gets_what_the_account_decides(tmp_path, monkeypatch, capsys):
    """The findings do not come between the CDK's arguments."""
    monkeypatch.setattr(preflight, "Cloud", lambda **_: Account(GetAccountSettings=limits()))
    context = [f"--context={key}={tmp_path}" for key in ("layer", "analysis_layer")]
    monkeypatch.setattr(sys, "argv", ["preflight", "--derive", *context])

    preflight.main()

    printed = capsys.readouterr()
    assert printed.out == "-c account_concurrency=1000 -c live_transport=iot\n"
    assert "1000 concurrent executions" in printed.err
    assert "live messages: by AWS IoT" in printed.err

    monkeypatch.setattr(sys, "argv", ["preflight", "--derive", "--unchecked", *context])
    preflight.main()
    unchecked = capsys.readouterr()
    assert unchecked.out == printed.out
    assert unchecked.err == f"by the account: {printed.out}"
