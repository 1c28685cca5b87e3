"""The emulator: ministack with our patches, its process, and the first calls of its functions."""
