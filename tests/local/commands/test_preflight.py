"""The preflight on the deployed embedded cloud: it answers the checks, and no finding stops a deployment."""

from __future__ import annotations

from stacks.settings import Settings
from verify.preflight import __main__ as preflight
from verify.preflight.finding import Verdict


def test_the_embedded_cloud_passes_the_preflight(embedded):
    findings = {one.item: one for one in preflight.look(embedded.cloud, Settings(embedded=True))}
    assert not preflight.stopped(list(findings.values())), findings
    said = {item: one.found for item, one in findings.items() if one.verdict is Verdict.FINE}
    assert "account 000000000000" in said["credentials"]
    assert said["stacks"] == "8 of 10 are there, each can be updated"
    assert said["names"] == "free, or used by this deployment"
    assert said["changed settings"] == "none that must not be"


def test_another_namespace_counts_as_a_first_deployment(embedded):
    settings = Settings(namespace="another", embedded=True)
    findings = {one.item: one for one in preflight.look(embedded.cloud, settings)}
    assert not preflight.stopped(list(findings.values())), findings
    assert findings["stacks"].found == "none: a first one"
    assert findings["changed settings"].found == "nothing is deployed"
