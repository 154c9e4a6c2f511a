"""Comparing methods: run time against error on one scene, from one state, in turns."""
