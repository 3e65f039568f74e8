"""The shield inside other programs. Each module needs the package of the same name.

They take a `specshield.local.LocalSession` or a session of the SDK, which have the same `step`.
"""
