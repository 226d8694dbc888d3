from .command import identify_response as identify_response
