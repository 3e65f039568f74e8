"""The shield inside what people already run. Each module needs the package that it is named after.

They take a `specshield.local.LocalSession` or a session of the SDK: both have the same `step`.
"""
