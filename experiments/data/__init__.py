"""Data modules cut photographs in linear light into reproducible crops."""
