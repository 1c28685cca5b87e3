"""The questions of robots: the function that answers each, and how it says that it does not."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from functions.shared import clients
from functions.shared.clients import variables
from iort_contract.catalog.environments import AnswerEnvironment
from iort_contract.catalog.questions import CAR_LIMITS, SAG, CarLimit, Question
from iort_contract.checks import json_object, shown
from iort_contract.cloud import RESULTS_PREFIX
from iort_contract.findings_table import FindingsTable
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import AnalysedDrive, DriveKey, Estimate, encode_estimate
from iort_contract.messages.files import parse_file_key
from iort_contract.messages.questions import (
    ANSWER_URL_S,
    ASK_FOLDER,
    INVALID,
    NO_DATA,
    TOO_LARGE,
    Content,
    Refusal,
)
from iort_contract.track import Track, parse_track, track_of

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client


# Makes the answer's body of a robot's name and the question's body. May raise `RefusedError`.
Work = Callable[[str, Mapping[str, Any]], Mapping[str, Any]]


class RefusedError(Exception):
    """A question that is not answered: one of the contract's `REASONS`, and a text for a person."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.refusal = Refusal(reason, text)


class Bodies:
    """Reads questions from the bucket, and writes answers there. ``signer`` signs their addresses, unless
    ``client`` does."""

    def __init__(self, client: S3Client, bucket: str, signer: S3Client | None = None) -> None:
        self._client, self._bucket, self._signer = client, bucket, signer or client

    def read(self, robot: str, question: Question, content: Content) -> Mapping[str, Any]:
        """The body of a question; raises `RefusedError`. A robot can name only its own files."""
        try:
            key = parse_file_key(content.place)
        except ContractError as error:
            raise RefusedError(INVALID, str(error)) from error
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


# A parameter that none of so many drives has is not known.
_DRIVES = 50


def newest_drives(robot: str) -> list[AnalysedDrive]:
    """The robot's analysed drives, the newest first."""
    table = FindingsTable(clients.dynamodb(), variables(AnswerEnvironment).findings_table)
    return list(table.drives(robot, most=_DRIVES))


def latest(drives: Iterable[AnalysedDrive]) -> dict[str, tuple[Estimate, DriveKey]]:
    """Each parameter with the first drive that has it."""
    found: dict[str, tuple[Estimate, DriveKey]] = {}
    for analysed in drives:
        for name, estimate in analysed.estimates.items():
            found.setdefault(name, (estimate, analysed.drive))
    return found


def calibration(robot: str, _body: Mapping[str, Any]) -> dict[str, Any]:
    """Each parameter of the robot by its name, from the newest drive that has it."""
    drives = newest_drives(robot)
    known = latest(drives)
    if not drives:
        raise RefusedError(NO_DATA, "no drive of this robot is analysed yet: `iort analyse`")
    if not known:
        reasons = Counter(reason for drive in drives for reason in set(drive.missing.values()))
        why = f", mostly because {reasons.most_common(1)[0][0]}" if reasons else ""
        raise RefusedError(NO_DATA, f"no parameter follows from the {len(drives)} analysed drives{why}")
    return {
        "parameters": {
            name: {**encode_estimate(estimate), "drive": str(drive)}
            for name, (estimate, drive) in sorted(known.items())
        }
    }


def raceline(robot: str, body: Mapping[str, Any]) -> dict[str, Any]:
    """The line from a ``track`` and a ``car``. Raises `RefusedError` for what is neither."""
    # Only here is numpy needed.
    from iort_analysis import AnalysisError  # noqa: PLC0415 - see above
    from iort_analysis.raceline import (  # noqa: PLC0415 - see above
        Limits,
        least_curvature,
        profile,
        reference,
    )

    try:
        track, car = _track(body.get("track")), _car(robot, body.get("car", {}))
        values = {name: found["value"] for name, found in car.items()}
        centre = reference(track, values.pop("width_m"))
        offset, limits = least_curvature(centre), Limits(**values)
        points = centre.line(offset)
        found, before = profile(points, limits), profile(centre.points, limits)
    except (AnalysisError, ContractError) as error:
        raise RefusedError(INVALID, str(error)) from error
    columns = {
        "s_m": found.at_m,
        "x_m": points[:, 0],
        "y_m": points[:, 1],
        "offset_m": offset,
        "curvature_1pm": found.curvature_1pm,
        "speed_mps": found.speed_mps,
        "time_s": found.time_s,
    }
    return {
        "length_m": round(found.length_m, 3),
        "lap_s": round(found.lap_s, 3),
        "centre_line_lap_s": round(before.lap_s, 3),
        "car": car,
        "line": {name: [round(float(value), 4) for value in values] for name, values in columns.items()},
    }


def _track(given: Any) -> Track:
    if isinstance(given, str):
        return parse_track(given)
    if isinstance(given, dict):
        return track_of(given)
    raise ContractError(f"track must be a CSV text or an object of columns, got {shown(given)}")


def _car(robot: str, given: Any) -> dict[str, dict[str, Any]]:
    """Each limit with its value and where it is from: the question, the calibration, or the default."""
    if not isinstance(given, dict) or given.keys() - CAR_LIMITS.keys():
        raise ContractError(f"car must be an object of {', '.join(CAR_LIMITS)}, got {shown(given)}")
    # Without a calibration to look up, the table is not read.
    wanted = any(limit.calibrated and name not in given for name, limit in CAR_LIMITS.items())
    drives = newest_drives(robot) if wanted else []
    known = {name: one.value for name, (one, _) in latest(drives).items()}
    car = {}
    for name, limit in CAR_LIMITS.items():
        source, value = "question", given.get(name)
        if name not in given:
            calibrated = _calibrated(limit, known)
            source, value = ("default", limit.default) if calibrated is None else ("calibration", calibrated)
        car[name] = {"value": _checked(limit, value), "unit": limit.unit, "from": source}
    return car


def _calibrated(limit: CarLimit, known: Mapping[str, float]) -> float | None:
    """The limit by the robot's parameters; None if one is missing, or the result is no such limit."""
    values = [known.get(name) for name in limit.calibrated]
    if not values or None in values:
        return None
    value = values[0]
    if limit.name == "power_w":
        volts, ohms = (float(one or 0) for one in values)
        value = SAG * (1 - SAG) * volts**2 / ohms if ohms > 0 else None
    return value if value is not None and limit.low <= value <= limit.high else None


def _checked(limit: CarLimit, value: Any) -> float:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    # Compared before it becomes a float, which holds no integer of 400 digits.
    if not is_number or not limit.low <= value <= limit.high:
        raise ContractError(
            f"{limit.name} must be {limit.low:g} to {limit.high:g} {limit.unit}, got {shown(value)}"
        )
    return float(value)


# By their names in the catalogue.
WORK: dict[str, Work] = {"calibration": calibration, "raceline": raceline}
