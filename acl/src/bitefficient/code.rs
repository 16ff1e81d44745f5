//! Codes of the bit-efficient encodings: the bytes that announce messages, envelopes and their
//! parts.
//!
//! The readers and the writers take every code from here. [`explain`](crate::explain()) runs the
//! readers, and so uses the same codes. Each module quotes the productions that it follows:
//! FIPA00069 (edition G) for messages, FIPA00088 (edition D) for envelopes.

/// `EndOfCollection = 0x01.`
///
/// Ends a message, an envelope, a stamp, an agent identifier, and a set or sequence.
pub(crate) const END: u8 = 0x01;

/// Version 1.0.
///
/// FIPA00069 2.4, note 2: "The version number byte contains the major version number in the upper
/// four bits and minor version number in the lower four bits. This specification defines version
/// 1.0 (coded as 0x10)."
pub(crate) const VERSION_1_0: u8 = 0x10;

/// `UserDefinedMsgType = 0x00 MsgTypeName.` The codes of the standard acts are those of
/// [`Performative`](crate::Performative).
pub(crate) const USER_DEFINED_PERFORMATIVE: u8 = 0x00;

/// First byte of a message (FIPA00069 2.2 `MessageId`).
///
/// FIPA00069 2.4, note 1: "The value 0xFA defines a bit-efficient coding scheme without dynamic
/// code tables and the value 0xFB defines a bit-efficient coding scheme with dynamic code tables.
/// The message identifier 0xFC is used when dynamic code tables are being used, but the sender does
/// not want to update code tables".
pub(crate) mod message_id {
    /// A message without code tables.
    pub(crate) const PLAIN: u8 = 0xfa;
    /// A message with code tables. Its new texts enter the table.
    pub(crate) const TABLE_UPDATED: u8 = 0xfb;
    /// A message with code tables. Its new texts do not enter the table.
    pub(crate) const TABLE_UNCHANGED: u8 = 0xfc;
}

/// Parameters of a message (FIPA00069 2.2 `PredefinedMsgParam`, `UserDefinedMsgParam`).
pub(crate) mod message {
    /// `UserDefinedMsgParam = 0x00 ParameterName ParameterValue.`
    pub(crate) const USER_DEFINED: u8 = 0x00;
    pub(crate) const SENDER: u8 = 0x02;
    pub(crate) const RECEIVER: u8 = 0x03;
    pub(crate) const CONTENT: u8 = 0x04;
    pub(crate) const REPLY_WITH: u8 = 0x05;
    pub(crate) const REPLY_BY: u8 = 0x06;
    pub(crate) const IN_REPLY_TO: u8 = 0x07;
    pub(crate) const REPLY_TO: u8 = 0x08;
    pub(crate) const LANGUAGE: u8 = 0x09;
    pub(crate) const ENCODING: u8 = 0x0a;
    pub(crate) const ONTOLOGY: u8 = 0x0b;
    pub(crate) const PROTOCOL: u8 = 0x0c;
    pub(crate) const CONVERSATION_ID: u8 = 0x0d;
}

/// Parts of an agent identifier, in both encodings.
///
/// FIPA00069 2.2: `AgentIdentifier = 0x02 AgentName [Addresses] [Resolvers]
/// (UserDefinedParameter)* EndOfCollection.`
pub(crate) mod agent {
    /// Begins an identifier. The name follows.
    pub(crate) const BEGIN: u8 = 0x02;
    /// `Addresses = 0x02 UrlCollection.`
    pub(crate) const ADDRESSES: u8 = 0x02;
    /// `Resolvers = 0x03 AgentIdentifierCollection.`
    pub(crate) const RESOLVERS: u8 = 0x03;
    /// FIPA00069 2.2: `UserDefinedParameter = 0x04 BinWord BinExpression.`
    pub(crate) const USER_DEFINED: u8 = 0x04;
    /// FIPA00088 2.3: `UserDefinedParameter = 0x05 NullTerminatedString Any.`
    pub(crate) const USER_DEFINED_IN_ENVELOPE: u8 = 0x05;
}

/// Words, numbers and strings (FIPA00069 2.2 `BinWord`, `BinNumber`, `BinString`).
///
/// An index refers to an entry of a code table.
pub(crate) mod token {
    /// `0x10 Word 0x00`
    pub(crate) const WORD: u8 = 0x10;
    pub(crate) const WORD_INDEX: u8 = 0x11;
    pub(crate) const NUMBER: u8 = 0x12;
    pub(crate) const HEX_NUMBER: u8 = 0x13;
    /// `0x14 String 0x00`
    pub(crate) const STRING: u8 = 0x14;
    pub(crate) const STRING_INDEX: u8 = 0x15;
    /// `0x16 Len8 ByteSeq`
    pub(crate) const LEN8: u8 = 0x16;
    /// `0x17 Len16 ByteSeq`
    pub(crate) const LEN16: u8 = 0x17;
    pub(crate) const LEN_INDEX: u8 = 0x18;
    /// `0x19 Len32 ByteSeq`
    pub(crate) const LEN32: u8 = 0x19;
    /// `BinExpression = BinExpr | 0xFF BinString.`
    pub(crate) const OPAQUE: u8 = 0xff;
}

/// An opening parenthesis, alone or fused with the token behind it (FIPA00069 2.2 `ExprStart`).
///
/// Unlike in [`token`], `Len32` comes before the index of a string with its length.
pub(crate) mod start {
    /// The parenthesis alone.
    pub(crate) const ALONE: u8 = 0x60;
    pub(crate) const WORD: u8 = 0x70;
    pub(crate) const WORD_INDEX: u8 = 0x71;
    pub(crate) const NUMBER: u8 = 0x72;
    pub(crate) const HEX_NUMBER: u8 = 0x73;
    pub(crate) const STRING: u8 = 0x74;
    pub(crate) const STRING_INDEX: u8 = 0x75;
    pub(crate) const LEN8: u8 = 0x76;
    pub(crate) const LEN16: u8 = 0x77;
    pub(crate) const LEN32: u8 = 0x78;
    pub(crate) const LEN_INDEX: u8 = 0x79;
}

/// A closing parenthesis, alone or fused with the token behind it (FIPA00069 2.2 `ExprEnd`), which
/// belongs to the outer level.
pub(crate) mod end {
    /// The parenthesis alone.
    pub(crate) const ALONE: u8 = 0x40;
    pub(crate) const WORD: u8 = 0x50;
    pub(crate) const WORD_INDEX: u8 = 0x51;
    pub(crate) const NUMBER: u8 = 0x52;
    pub(crate) const HEX_NUMBER: u8 = 0x53;
    pub(crate) const STRING: u8 = 0x54;
    pub(crate) const STRING_INDEX: u8 = 0x55;
    pub(crate) const LEN8: u8 = 0x56;
    pub(crate) const LEN16: u8 = 0x57;
    pub(crate) const LEN32: u8 = 0x58;
    pub(crate) const LEN_INDEX: u8 = 0x59;
}

/// Whether the code opens a level of an expression.
pub(crate) fn opens_level(code: u8) -> bool {
    matches!(code, start::ALONE | start::WORD..=start::LEN_INDEX)
}

/// Whether the code closes a level of an expression.
pub(crate) fn closes_level(code: u8) -> bool {
    matches!(code, end::ALONE | end::WORD..=end::LEN_INDEX)
}

/// The kind of token that a code of [`token`], [`start`] or [`end`] announces.
#[derive(Clone, Copy)]
pub(crate) enum TokenKind {
    /// The parenthesis alone.
    None,
    Word,
    Number,
    String,
    Len8,
    Len16,
    Len32,
    /// A word or a string of the code table.
    TextIndex,
    /// A string with its length, of the code table.
    LenIndex,
}

impl TokenKind {
    pub(crate) fn of(code: u8) -> Option<Self> {
        Some(match code {
            start::ALONE | end::ALONE => Self::None,
            token::WORD | start::WORD | end::WORD => Self::Word,
            token::NUMBER | start::NUMBER | end::NUMBER => Self::Number,
            token::HEX_NUMBER | start::HEX_NUMBER | end::HEX_NUMBER => Self::Number,
            token::STRING | start::STRING | end::STRING => Self::String,
            token::LEN8 | start::LEN8 | end::LEN8 => Self::Len8,
            token::LEN16 | start::LEN16 | end::LEN16 => Self::Len16,
            token::LEN32 | start::LEN32 | end::LEN32 => Self::Len32,
            token::WORD_INDEX | start::WORD_INDEX | end::WORD_INDEX => Self::TextIndex,
            token::STRING_INDEX | start::STRING_INDEX | end::STRING_INDEX => Self::TextIndex,
            token::LEN_INDEX | start::LEN_INDEX | end::LEN_INDEX => Self::LenIndex,
            _ => return None,
        })
    }
}

/// Dates and times (FIPA00069 2.2 `BinDateTimeToken`).
///
/// FIPA00088 2.4, note 3: "Information as to whether the type designator is present or not is coded
/// into an identifier byte."
pub(crate) mod date_time {
    pub(crate) const ABSOLUTE: u8 = 0x20;
    /// A relative time with `+`.
    pub(crate) const AFTER: u8 = 0x21;
    /// A relative time with `-`.
    pub(crate) const BEFORE: u8 = 0x22;
    /// Difference between the code with a type designator and the code without one.
    pub(crate) const WITH_DESIGNATOR: u8 = 0x04;
    pub(crate) const ABSOLUTE_WITH_DESIGNATOR: u8 = ABSOLUTE + WITH_DESIGNATOR;
    pub(crate) const AFTER_WITH_DESIGNATOR: u8 = AFTER + WITH_DESIGNATOR;
    pub(crate) const BEFORE_WITH_DESIGNATOR: u8 = BEFORE + WITH_DESIGNATOR;
}

/// First byte and parameters of an envelope (FIPA00088 2.3 `PredefinedParameter`).
pub(crate) mod envelope {
    /// `ExtMsgId = 0xFD.`
    pub(crate) const EXTENSION: u8 = 0xfd;
    /// `BaseMsgId = 0xFE.`
    pub(crate) const BASE: u8 = 0xfe;

    /// `UserDefinedParameter = 0x00 Keyword NullTerminatedString.`
    pub(crate) const USER_DEFINED: u8 = 0x00;
    pub(crate) const TO: u8 = 0x02;
    pub(crate) const FROM: u8 = 0x03;
    pub(crate) const ACL_REPRESENTATION: u8 = 0x04;
    pub(crate) const COMMENTS: u8 = 0x05;
    pub(crate) const PAYLOAD_LENGTH: u8 = 0x06;
    pub(crate) const PAYLOAD_ENCODING: u8 = 0x07;
    pub(crate) const INTENDED_RECEIVER: u8 = 0x09;
    pub(crate) const RECEIVED: u8 = 0x0a;
    pub(crate) const TRANSPORT_BEHAVIOR: u8 = 0x0b;
}

/// Parts of a stamp (FIPA00088 2.3).
///
/// `ReceivedObject = By Date [From] [Id] [Via] (UserDefinedParameter)* EndOfCollection.`
pub(crate) mod stamp {
    pub(crate) const USER_DEFINED: u8 = 0x00;
    pub(crate) const FROM: u8 = 0x02;
    pub(crate) const ID: u8 = 0x03;
    pub(crate) const VIA: u8 = 0x04;
}

/// Values of `acl-representation` (FIPA00088 2.3 `ACLRepresentation`).
pub(crate) mod representation {
    /// `UserDefinedACLRepresentation = 0x00 NullTerminatedString.`
    pub(crate) const NAMED: u8 = 0x00;
    pub(crate) const BIT_EFFICIENT: u8 = 0x10;
    pub(crate) const STRING: u8 = 0x11;
    pub(crate) const XML: u8 = 0x12;
}
