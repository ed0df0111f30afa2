"""Stored results: what was measured, by which command, and whether it still holds."""
