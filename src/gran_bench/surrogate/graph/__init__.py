"""The graph network: messages between particles and closest wall points."""
