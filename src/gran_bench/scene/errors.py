"""The one error of a scene."""


class SceneError(ValueError):
    """A scene that cannot exist; the message names the key, the value and the remedy."""
