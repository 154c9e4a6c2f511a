"""Runs side by side: what differs between them, and what the judge found."""
