"""Figures: legible, with units, colour-blind safe, written whole or not at all."""
