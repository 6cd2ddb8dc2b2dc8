"""Self-contained web page that shows a scene, or a flight's points, in three dimensions."""
