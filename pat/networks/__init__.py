"""The networks, their building blocks and their weights."""
