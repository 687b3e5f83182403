"""Shared by drivers: the thread that reads a link, samples in order, network ports."""
