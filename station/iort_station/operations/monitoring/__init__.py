"""CloudWatch for people: alarms with what they mean, dashboards, and log records as they are read."""
