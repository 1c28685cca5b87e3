"""What robots and operators ask the cloud, with the answers: questions, upload addresses, samples."""
