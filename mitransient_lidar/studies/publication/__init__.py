"""Figures and statements of FOI's multipixel lidar model (Tulldahl 2006, FOI-R--2074--SE), computed again."""
