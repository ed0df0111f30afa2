"""Reinforcement learning rules that tune an NMPC from plant data."""
