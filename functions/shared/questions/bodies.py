"""The bodies of questions and answers that are files in the bucket."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from functions.shared.questions.work import RefusedError
from iort_contract.catalog.questions import Question
from iort_contract.checks import json_object
from iort_contract.cloud import RESULTS_PREFIX
from iort_contract.limits import ContractError
from iort_contract.messages.requests.ask import ANSWER_URL_S, ASK_FOLDER, INVALID, TOO_LARGE, Content
from iort_contract.messages.requests.files import parse_file_key

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client


class Bodies:
    """Reads questions from the bucket, and writes answers there. ``signer`` signs their addresses, unless
    ``client`` does."""

    def __init__(self, client: S3Client, bucket: str, signer: S3Client | None = None) -> None:
        self._client, self._bucket, self._signer = client, bucket, signer or client

    def read(self, robot: str, question: Question, content: Content) -> Mapping[str, Any]:
        """The body of a question; raises `RefusedError`. A robot can name only its own files."""
        key = parse_file_key(content.place)
        if key.robot != robot or not key.name.startswith(f"{ASK_FOLDER}/"):
            raise RefusedError(INVALID, f"the file must be {robot}'s own, in {ASK_FOLDER}/")
        check_size(content.size, question.max_question_bytes)
        try:
            found = self._client.get_object(Bucket=self._bucket, Key=content.place)
        except self._client.exceptions.ClientError as error:
            raise RefusedError(INVALID, f"the file {content.place} cannot be read: {error}") from error
        # One byte more than told shows a longer file.
        text = found["Body"].read(content.size + 1)
        if hashlib.sha256(text).hexdigest() != content.sha256:
            raise RefusedError(INVALID, f"the file {content.place} has another SHA-256 than told")
        try:
            return json_object(text, "the file")
        except ContractError as error:
            raise RefusedError(INVALID, str(error)) from error

    def write(self, robot: str, request_id: str, text: bytes) -> Content:
        """Store an answer for a day; returns its address."""
        key = f"{RESULTS_PREFIX}{ASK_FOLDER}/{robot}/{request_id}.json"
        self._client.put_object(Bucket=self._bucket, Key=key, Body=text, ContentType="application/json")
        place = {"Bucket": self._bucket, "Key": key}
        url = self._signer.generate_presigned_url("get_object", Params=place, ExpiresIn=ANSWER_URL_S)
        return Content(url, hashlib.sha256(text).hexdigest(), len(text))


def check_size(size: int, most: int) -> None:
    """Raise `RefusedError` for a question that is too large."""
    if size > most:
        raise RefusedError(TOO_LARGE, f"the question must have at most {most} bytes, got {size}")
