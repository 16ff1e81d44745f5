import jade.core.AID;
import jade.lang.acl.ACLMessage;
import jade.lang.acl.StringACLCodec;
import java.io.BufferedReader;
import java.io.InputStreamReader;
import java.io.PrintStream;
import java.nio.charset.StandardCharsets;
import java.util.Map;
import java.util.function.Function;

/**
 * Records how the lexer of JADE reads values of string messages.
 *
 * <p>A line of the input is a parameter, a tab, and the value as it is in the message. Bytes other than
 * printable ASCII, blanks and percent signs are percent-encoded. The output adds a tab and the text that JADE reads
 * behind {@code =}, or {@code !} if JADE refuses the message.
 */
public class ReadTexts {
    private record Parameter(String template, Function<ACLMessage, String> text) {}

    private static final Map<String, Parameter> PARAMETERS =
            Map.ofEntries(
                    Map.entry("name", agent("(INFORM :sender (agent-identifier :name @))", AID::getName)),
                    Map.entry(
                            "address",
                            agent(
                                    "(INFORM :sender (agent-identifier :name a :addresses (sequence @)))",
                                    aid -> String.join(" ", aid.getAddressesArray()))),
                    Map.entry(
                            "resolver",
                            agent(
                                    "(INFORM :sender (agent-identifier :name a :resolvers (sequence "
                                            + "(agent-identifier :name @))))",
                                    aid -> aid.getResolversArray()[0].getName())),
                    Map.entry(
                            "agent-value",
                            agent(
                                    "(INFORM :sender (agent-identifier :name a :X-k @))",
                                    aid -> aid.getAllUserDefinedSlot().getProperty("k"))),
                    Map.entry(
                            "agent-key",
                            agent(
                                    "(INFORM :sender (agent-identifier :name a :X-@ v))",
                                    aid -> (String) aid.getAllUserDefinedSlot().propertyNames().nextElement())),
                    Map.entry(
                            "receiver",
                            of("(INFORM :receiver (set (agent-identifier :name @)))",
                                    message -> ((AID) message.getAllReceiver().next()).getName())),
                    Map.entry(
                            "reply-to",
                            of("(INFORM :reply-to (set (agent-identifier :name @)))",
                                    message -> ((AID) message.getAllReplyTo().next()).getName())),
                    Map.entry("reply-with", of("(INFORM :reply-with @)", ACLMessage::getReplyWith)),
                    Map.entry("in-reply-to", of("(INFORM :in-reply-to @)", ACLMessage::getInReplyTo)),
                    Map.entry("language", of("(INFORM :language @)", ACLMessage::getLanguage)),
                    Map.entry("encoding", of("(INFORM :encoding @)", ACLMessage::getEncoding)),
                    Map.entry("ontology", of("(INFORM :ontology @)", ACLMessage::getOntology)),
                    Map.entry("protocol", of("(INFORM :protocol @)", ACLMessage::getProtocol)),
                    Map.entry(
                            "conversation-id",
                            of("(INFORM :conversation-id @)", ACLMessage::getConversationId)),
                    Map.entry(
                            "value",
                            of("(INFORM :X-k @)", message -> message.getUserDefinedParameter("k"))),
                    Map.entry(
                            "key",
                            of("(INFORM :X-@ v)",
                                    message ->
                                            (String)
                                                    message.getAllUserDefinedParameters()
                                                            .propertyNames()
                                                            .nextElement())),
                    Map.entry("content", of("(INFORM :content @)", ACLMessage::getContent)),
                    Map.entry(
                            "content-in-base64",
                            of("(INFORM :X-JADE-Encoding Base64 :content @)",
                                    message ->
                                            new String(
                                                    message.getByteSequenceContent(),
                                                    StandardCharsets.UTF_8))));

    private static Parameter of(String template, Function<ACLMessage, String> text) {
        return new Parameter(template, text);
    }

    private static Parameter agent(String template, Function<AID, String> text) {
        return new Parameter(template, message -> text.apply(message.getSender()));
    }

    public static void main(String[] arguments) throws Exception {
        BufferedReader in =
                new BufferedReader(new InputStreamReader(System.in, StandardCharsets.US_ASCII));
        PrintStream out = new PrintStream(System.out, true, StandardCharsets.US_ASCII);
        for (String line = in.readLine(); line != null; line = in.readLine()) {
            String[] columns = line.split("\t", -1);
            out.println(columns[0] + "\t" + columns[1] + "\t" + read(columns[0], columns[1]));
        }
    }

    private static String read(String name, String value) {
        Parameter parameter = PARAMETERS.get(name);
        String message = parameter.template().replace("@", decoded(value));
        try {
            byte[] bytes = message.getBytes(StandardCharsets.UTF_8);
            ACLMessage read = new StringACLCodec().decode(bytes, "UTF-8");
            return "=" + encoded(parameter.text().apply(read));
        } catch (Exception | Error refused) {
            return "!";
        }
    }

    private static String decoded(String value) {
        byte[] bytes = new byte[value.length()];
        int length = 0;
        for (int at = 0; at < value.length(); at++) {
            if (value.charAt(at) == '%') {
                bytes[length++] = (byte) Integer.parseInt(value.substring(at + 1, at + 3), 16);
                at += 2;
            } else {
                bytes[length++] = (byte) value.charAt(at);
            }
        }
        return new String(bytes, 0, length, StandardCharsets.UTF_8);
    }

    private static String encoded(String text) {
        StringBuilder out = new StringBuilder();
        for (byte signed : text.getBytes(StandardCharsets.UTF_8)) {
            int value = signed & 0xff;
            if (value >= '!' && value <= '~' && value != '%') {
                out.append((char) value);
            } else {
                out.append(String.format("%%%02x", value));
            }
        }
        return out.toString();
    }
}
