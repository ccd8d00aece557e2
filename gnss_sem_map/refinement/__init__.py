"""Refinement (section 3.3): what the whole map knows that no single view does. `steps.py` is the list of its steps."""
