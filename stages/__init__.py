"""The stages, one package each; `stages.registry` lists them in order.

Nothing is imported here, so that one stage can be used on a machine that lacks what the others need.
"""
