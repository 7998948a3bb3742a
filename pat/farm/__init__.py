"""Many scenes rendered: worker processes, retries, resuming, clusters.

The folder of a job holds `manifest.yaml` (what is rendered, by which versions), `scenes/000012/` (scene 12; that the
folder exists means that it is complete), `scenes.jsonl` (a line for each, with the figures of its check), and
`quarantine/000013/` (why scene 13 was abandoned, with the log of the process). `.work` holds unfinished scenes.
"""
