"""Tests of the four packages."""
