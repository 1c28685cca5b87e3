"""The racing line of a track: of least curvature, and as fast along it as the car's limits allow."""
