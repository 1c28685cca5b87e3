"""The stack that watches the others: dashboards, alarms and the budget."""
