"""The policies, one module each. A policy decides which node is fit, and which data go where
(`rass_mav.core.policy.Policy`).

`settings.kinds` finds them: a new one only needs a module of this package that defines `POLICIES`
(docs/contribute/guide.md).
"""
