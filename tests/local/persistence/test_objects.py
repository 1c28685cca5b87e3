"""The files of objects."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path

from ministack.core.responses import request_scope
from ministack.services import s3

from local.persistence.ledger import Ledger
from local.persistence.tables import _Files
from tests.local.persistence.in_process import ACCOUNT, REGION


def test_an_object_in_new_folders_survives_a_power_cut(tmp_path, monkeypatch):
    monkeypatch.setattr(s3, "DATA_DIR", str(tmp_path / "s3"))
    synced = set()
    with request_scope(ACCOUNT, REGION), closing(Ledger(tmp_path / "ledger.db", sync="full")) as ledger:
        monkeypatch.setattr(
            os, "fsync", lambda file: synced.add(str(Path(f"/proc/self/fd/{file}").readlink()))
        )
        _Files(ledger).persist("bucket", "robots/car1/drive.bag", {"body": b"bytes", "etag": "x", "size": 5})
    folder = tmp_path / "s3" / ACCOUNT / "bucket" / "robots" / "car1"
    wanted = [folder, *folder.parents[:4]]
    assert wanted[-1] == tmp_path / "s3"
    assert {str(one) for one in wanted} <= synced
