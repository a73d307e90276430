"""The version of the package, said once: the face, run outputs and the build read it here."""

__all__ = ["__version__"]

__version__ = "0.1.0"
