"""Finds the resources of other stacks to watch, so that no new one is forgotten."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from aws_cdk import Stack
from aws_cdk import aws_dynamodb as dynamodb
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_sqs as sqs
from aws_cdk import aws_stepfunctions as stepfunctions


@dataclass(frozen=True)
class Watched:
    """Functions, tables and queues by their construct's name; ``readers`` are the functions that read a
    stream. ``machines`` are state machines by their stack's name."""

    functions: Mapping[str, lambda_.Function]
    tables: Mapping[str, dynamodb.Table]
    queues: Mapping[str, sqs.Queue]
    readers: Mapping[str, lambda_.Function]
    machines: Mapping[str, stepfunctions.StateMachine]

    @classmethod
    def of(cls, stacks: Iterable[Stack]) -> Watched:
        """All resources of the stacks, in order."""
        functions: dict[str, lambda_.Function] = {}
        tables: dict[str, dynamodb.Table] = {}
        queues: dict[str, sqs.Queue] = {}
        readers: dict[str, lambda_.Function] = {}
        machines: dict[str, stepfunctions.StateMachine] = {}
        for stack in stacks:
            for construct in stack.node.find_all():
                if isinstance(construct, lambda_.Function):
                    functions[construct.node.id] = construct
                elif isinstance(construct, dynamodb.Table):
                    tables[construct.node.id] = construct
                elif isinstance(construct, sqs.Queue):
                    queues[construct.node.id] = construct
                elif isinstance(construct, stepfunctions.StateMachine):
                    machines[type(stack).__name__] = construct
                elif isinstance(construct, lambda_.EventSourceMapping):
                    reader = construct.node.scope
                    if isinstance(reader, lambda_.Function):
                        readers[reader.node.id] = reader
        return cls(functions, tables, queues, readers, machines)
