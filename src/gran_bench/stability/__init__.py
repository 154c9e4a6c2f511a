"""What is done to the software on purpose to see whether it holds."""
