"""From photographs of a target to a rig, and from a rig to a better rig."""
