"""The discrete element method: Hertz–Mindlin contacts with history, analytic walls, two engines."""
