"""Many scenes rendered: what is to be rendered, the renderers, and the job that makes those that are
missing.
"""
