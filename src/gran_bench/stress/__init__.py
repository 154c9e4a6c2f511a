"""The stress test: a fixed list of hard cases, each with an expectation that was written before it ran."""
