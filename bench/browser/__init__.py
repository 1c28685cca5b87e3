"""Commands that look at the page in Chromium, or drive from it."""
