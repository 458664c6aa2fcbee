"""The one place that knows everything: entry script, supervision, configuration, offline tools.

May import all other packages; none imports this one.
"""
