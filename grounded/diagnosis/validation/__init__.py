"""Validation on held-out trials: which of the likely effects are claimed, and how certain they are.

Read `ruler`, then `choose` (the rule) and `decide` (its options and guards). The stages and their
modules are listed in `grounded.diagnosis.diagnose`.
"""
