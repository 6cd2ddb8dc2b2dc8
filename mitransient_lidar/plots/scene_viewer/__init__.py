"""Self-contained web page that shows a scene, or the points of a flight, in three dimensions."""
