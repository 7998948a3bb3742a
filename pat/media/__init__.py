"""Reading, writing and conversion of images, raw counts, colour, depth maps, video and figures."""
