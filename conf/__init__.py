"""The configurations that Hydra composes; one YAML file is one choice."""
