"""From samples to messages: streams, batches, live samples and pings. It uses sources, spool, files and
mqtt."""
