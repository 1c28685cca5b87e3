"""`make verify-aws`: asks a deployment about the assumptions of the design. Only tests import it."""
