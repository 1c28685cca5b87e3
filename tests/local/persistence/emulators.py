"""A kept emulator without the project's stacks, which a test may kill."""

from __future__ import annotations

import io
import json
import os
import resource
import signal
import ssl
import sys
import urllib.request
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import boto3
from botocore.config import Config

from local.deployment import ROOT
from local.emulator import package
from local.network.certificates import Authority
from local.processes import Child
from testkit.ports import free_port

REGION, ACCOUNT = "eu-west-1", "000000000000"
ROLE = f"arn:aws:iam::{ACCOUNT}:role/anybody"
_POLL_S = 0.05


class Emulator:
    """The emulator's process and its clients; `kill` and `start` as often as wanted."""

    sync, arguments = "normal", ("-m", "local.emulator.run")

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ledger = folder / "ledger.db"
        self.port, self.mqtt_port = free_port(), free_port()
        self.certificate, self._key = Authority().write(folder, "gateway", "127.0.0.1")
        self.process: Child

    def start(self) -> None:
        environment = {
            "PATH": os.environ["PATH"],
            "HOME": str(self.folder),
            "TMPDIR": str(self.folder),
            "STATE_DIR": str(self.folder / "state"),
            "S3_DATA_DIR": str(self.folder / "s3"),
            "IORT_LEDGER": str(self.ledger),
            "IORT_LEDGER_SYNC": self.sync,
            "AUTH": "true",
            "BIND_HOST": "127.0.0.1",
            "MINISTACK_HOST": "127.0.0.1",
            "MINISTACK_REGION": REGION,
            "GATEWAY_PORT": str(self.port),
            "IOT_MTLS_PORT": str(self.mqtt_port),
            "SFTP_ENABLED": "0",
            "USE_SSL": "1",
            "MINISTACK_SSL_CERT": str(self.certificate),
            "MINISTACK_SSL_KEY": str(self._key),
            "AWS_CA_BUNDLE": str(self.certificate),
            "PYTHONPATH": str(package.folder()),
        }
        self.process = Child(
            "the emulator",
            [sys.executable, *self.arguments],
            environment=environment,
            cwd=ROOT,
            log=self.folder / "emulator.log",
            orphaned=signal.SIGKILL,
        )
        while not self._ready():
            self.process.check()
            self.process.wait(_POLL_S)

    def kill(self) -> None:
        """SIGKILL to it and to its workers."""
        self.process.kill()

    def restart(self) -> None:
        """Kill it and start it again."""
        self.kill()
        self.start()

    def client(self, service: str, session: dict[str, Any] | None = None) -> Any:
        """A client of the root user, or of the session's role."""
        given = session or {"AccessKeyId": "test", "SecretAccessKey": "test", "SessionToken": None}
        return boto3.client(
            service,
            region_name=REGION,
            endpoint_url=f"https://127.0.0.1:{self.port}",
            verify=str(self.certificate),
            aws_access_key_id=given["AccessKeyId"],
            aws_secret_access_key=given["SecretAccessKey"],
            aws_session_token=given["SessionToken"],
            config=Config(retries={"total_max_attempts": 1}),
        )

    def add_role(self) -> None:
        """The role `ROLE`, which anybody may take."""
        anybody = {"Effect": "Allow", "Principal": "*", "Action": "sts:AssumeRole"}
        policy = json.dumps({"Version": "2012-10-17", "Statement": [anybody]})
        self.client("iam").create_role(RoleName="anybody", AssumeRolePolicyDocument=policy)

    def add_table(self, name: str) -> None:
        """A table with a stream, whose items have a `key`."""
        self.client("dynamodb").create_table(
            TableName=name,
            KeySchema=[{"AttributeName": "key", "KeyType": "HASH"}],
            AttributeDefinitions=[{"AttributeName": "key", "AttributeType": "S"}],
            BillingMode="PAY_PER_REQUEST",
            StreamSpecification={"StreamEnabled": True, "StreamViewType": "NEW_IMAGE"},
        )

    def add_function(self, name: str, code: str) -> str:
        """A function; returns its ARN."""
        package = io.BytesIO()
        with zipfile.ZipFile(package, "w") as archive:
            archive.writestr("module.py", code)
        made = self.client("lambda").create_function(
            FunctionName=name,
            Runtime="python3.12",
            Role=ROLE,
            Handler="module.handler",
            Timeout=900,
            Code={"ZipFile": package.getvalue()},
        )
        return str(made["FunctionArn"])

    @contextmanager
    def full_disk(self) -> Iterator[None]:
        """Let no file of the emulator grow beyond a page of the ledger."""
        unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
        try:
            yield
        finally:
            resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, unlimited)

    def _ready(self) -> bool:
        context = ssl.create_default_context(cafile=str(self.certificate))
        with suppress(OSError):
            url = f"https://127.0.0.1:{self.port}/_ministack/ready"
            with urllib.request.urlopen(url, timeout=5, context=context):
                return True
        return False
