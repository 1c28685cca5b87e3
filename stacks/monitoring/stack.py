"""Dashboards over every service that a message passes, alarms, and the budget."""

from __future__ import annotations

from collections.abc import Sequence

from aws_cdk import App, Stack
from aws_cdk import aws_budgets as budgets
from aws_cdk import aws_sns as sns

from stacks.monitoring.alarms import Alarms
from stacks.monitoring.dashboards import Dashboards
from stacks.monitoring.watched import Watched
from stacks.parts.base import PlatformStack
from stacks.settings import Settings


class Monitoring(PlatformStack):
    """Watches every function, table and queue of ``stacks``; alarms notify ``topic``."""

    def __init__(self, app: App, settings: Settings, *, stacks: Sequence[Stack], topic: sns.ITopic) -> None:
        super().__init__(app, "monitoring", settings)
        watched = Watched.of(stacks)
        alarms = Alarms(self, settings, watched=watched, topic=topic)
        Dashboards(self, settings, watched=watched, alarms=alarms.every)
        if settings.budget_usd:
            self._budget(settings)

    def _budget(self, settings: Settings) -> None:
        """For the whole account: a budget by tag counts nothing until somebody activates the tag."""

        def told(kind: str, percent: float) -> budgets.CfnBudget.NotificationWithSubscribersProperty:
            return budgets.CfnBudget.NotificationWithSubscribersProperty(
                notification=budgets.CfnBudget.NotificationProperty(
                    notification_type=kind,
                    comparison_operator="GREATER_THAN",
                    threshold=percent,
                    threshold_type="PERCENTAGE",
                ),
                subscribers=[
                    budgets.CfnBudget.SubscriberProperty(
                        subscription_type="EMAIL", address=settings.alarm_email or ""
                    )
                ],
            )

        budgets.CfnBudget(
            self,
            "Budget",
            budget=budgets.CfnBudget.BudgetDataProperty(
                budget_type="COST",
                time_unit="MONTHLY",
                budget_limit=budgets.CfnBudget.SpendProperty(amount=settings.budget_usd, unit="USD"),
            ),
            notifications_with_subscribers=[told("ACTUAL", 80), told("FORECASTED", 100)],
        )
