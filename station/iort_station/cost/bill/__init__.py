"""A bill's line items by what makes them: the messages, the archive, the analysis, the deployment itself."""
