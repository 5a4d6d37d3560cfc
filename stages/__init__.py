"""The stages, one package each; `stages.registry` lists them in order.

This file imports nothing, so that one stage can run on a machine without the libraries of the others.
"""
