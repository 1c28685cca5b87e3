"""Recordings for other tools (MCAP, ROS 1 bags, CSV, Parquet), the messages in them, and batches from other
tables. This room uses the data room, and knows neither verbs nor the page."""
