"""The paper's section Simulations, and what it leaves open, from one command."""
