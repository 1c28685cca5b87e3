"""What robots send and have sent, for Foxglove, Lichtblick and PlotJuggler: Foxglove's WebSocket protocol."""
