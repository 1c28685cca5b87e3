"""The analysis of drives on the embedded cloud."""
