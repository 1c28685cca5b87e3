"""The parameters of a robot's drives, in the findings table."""

from __future__ import annotations

import json
import logging

from functions.shared import clients
from functions.shared.environment import variables
from iort_contract.catalog.environments import AnswerEnvironment
from iort_contract.limits import ContractError
from iort_contract.messages.findings import DriveKey, Estimate, decode_parameters
from iort_contract.tables import CONTENT, FINDING, PARAMETERS_OF, ROBOT

_log = logging.getLogger(__name__)
# A parameter that none of so many drives has is not known.
_DRIVES = 50


def latest(robot: str) -> dict[str, tuple[Estimate, DriveKey]]:
    """Each parameter with the newest drive that has it."""
    answer = clients.dynamodb().query(
        TableName=variables(AnswerEnvironment).findings_table,
        KeyConditionExpression="#robot = :robot AND begins_with(#finding, :drives)",
        ExpressionAttributeNames={"#robot": ROBOT, "#finding": FINDING},
        ExpressionAttributeValues={":robot": {"S": robot}, ":drives": {"S": PARAMETERS_OF}},
        ScanIndexForward=False,
        Limit=_DRIVES,
    )
    found: dict[str, tuple[Estimate, DriveKey]] = {}
    for item in answer["Items"]:
        try:
            drive = decode_parameters(json.loads(item[CONTENT]["S"]))
        except (ContractError, KeyError, ValueError) as error:
            _log.warning("the parameters %s of %s cannot be read: %s", item[FINDING], robot, error)
            continue
        for name, estimate in drive.estimates.items():
            found.setdefault(name, (estimate, drive.drive))
    return found
