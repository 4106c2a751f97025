"""Attacks on a running service, and what a normal camera feels during each."""
