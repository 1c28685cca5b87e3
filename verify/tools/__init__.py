"""Tools of several questions: robots, batches, files, mails. They may use everything but the questions."""
