"""Images, raw counts, colour, video and figures: reading, writing, conversions."""
