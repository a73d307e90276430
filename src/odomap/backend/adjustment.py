"""Bundle adjustment in the large: views, points and lenses that agree best with what was seen."""

from odomap.backend.adjustment_problem import Adjustment

__all__ = ["Adjustment"]
