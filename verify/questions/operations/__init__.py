"""Questions about what runs and is watched: functions, logs, alarms."""
