"""What several questions need: robots, batches, files, mails. It may use everything but the questions."""
