"""The policies, one module each. A policy is who is fit, and what goes to whom (`rass_mav.core.policy.Policy`).

`settings.kinds` finds them: a module of this package that states `POLICIES` is all that a new one needs
(docs/development.md).
"""
