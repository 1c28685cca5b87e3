"""Objects end by the lifecycle rules that a template gives to their bucket."""

from __future__ import annotations

import time

import pytest
from ministack.core.responses import request_scope
from ministack.services import s3
from ministack.services.cloudformation import provisioners

from local.emulator.fixes import alarms, storage

DAY_S = 86_400
RULES = [
    {"Status": "Enabled", "Id": "old", "Prefix": "results/", "ExpirationInDays": 1},
    {"Status": "Disabled", "Prefix": "kept/", "ExpirationInDays": 1},
    {"Status": "Enabled", "AbortIncompleteMultipartUpload": {"DaysAfterInitiation": 2}},
]


@pytest.fixture
def bucket(monkeypatch):
    monkeypatch.setattr(provisioners, "_S3_BUCKET_CONFIGURATIONS", provisioners._S3_BUCKET_CONFIGURATIONS)
    monkeypatch.setattr(alarms, "BEFORE_ALARMS", [])
    storage.close_object_expiry()
    with request_scope("000000000000", "eu-west-1"):
        properties = {"BucketName": "expiring", "LifecycleConfiguration": {"Rules": RULES}}
        yield provisioners._s3_create("Bucket", properties, "stack")[0]
        s3.reset()


def test_objects_and_abandoned_uploads_end_by_the_rules(bucket):
    for key in ("results/a", "kept/a"):
        s3._put_object(bucket, key, b"bytes", {})
    s3._create_multipart_upload(bucket, "results/b", {})

    def left(days):
        storage.expire(time.time() + days * DAY_S)
        return list(s3._buckets[bucket]["objects"]), len(s3._multipart_uploads)

    assert left(0.9) == (["results/a", "kept/a"], 1)
    assert left(1.1) == (["kept/a"], 1)
    assert left(2.1) == (["kept/a"], 0)
