"""Shapes made by rules: furniture, household objects, machine parts."""
