"""The physics-aware transformer: one picture from an array of unlike cameras."""
