"""One snapshot a stack and stage: a change of what is deployed shows. Update: pytest --snapshot-update."""

from __future__ import annotations

import json
import re

import pytest

STACKS = (
    *("fleet", "storage", "quarantine", "processing", "ingest", "archive", "analysis", "monitoring"),
    "account",
)
_ASSET = re.compile(r"[0-9a-f]{64}")


def test_the_stacks_are_these(synthesized):
    assert set(synthesized.templates) == set(STACKS)


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("stage", ["synthesized", "production"])
def test_template(request, snapshot, stack, stage):
    templates = request.getfixturevalue(stage).templates
    template = {k: v for k, v in templates[stack].items() if k not in ("Parameters", "Rules")}
    # Other tests hold the content of the code and the layer, and the CDK's number of the layer.
    masked = _ASSET.sub("<asset>", json.dumps(template))
    assert json.loads(masked) == snapshot
