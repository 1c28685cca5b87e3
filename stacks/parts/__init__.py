"""What several stacks are made of: functions, queues, keys, policies. It knows the settings, and no stack."""
