"""Readers of labelled frames, each yielding the one in-memory form of `labels`."""
